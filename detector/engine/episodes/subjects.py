"""Subjects: the clients that an episode is about."""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

from wayside.names import subject_text
from wayside.rules import ClientSubject, CompiledRule, FleetSubject, PairSubject

FLEET: Final = ""
"""Stands in for a client's name: the fleet. No client has an empty name."""


class Subject(NamedTuple):
    """Clients, and the element of `each` if the rule has one."""

    clients: tuple[str, ...]
    """One client, the two of a pair (a, then b), or none for the fleet."""
    element: str | None = None

    @property
    def text(self) -> str:
        """The text in events' keys: `car1`, `car1+car2~north`, `~fleet`."""
        return _text(self.clients, self.element)


_text = lru_cache(maxsize=100_000)(subject_text)


def fits(rule: CompiledRule, subject: Subject) -> bool:
    """Whether the rule can have an episode about the subject."""
    clients, element = subject
    if element not in {each.name for each in rule.elements}:
        return False
    match rule.subject:
        case ClientSubject():
            return len(clients) == 1
        case PairSubject() as pairs:
            return len(set(clients)) == 2 == len(clients) and (pairs.ordered or clients[0] < clients[1])
        case FleetSubject():
            return not clients
