"""Signals that plugins compute: the calls of the engine, and how it uses the results.

A plugin's value is computed at each evaluation, for the rule's subject, from the buffer at that tick. Its host
(detector/plugins) decides where and how a plugin runs. The engine only calls it, in a fixed order, and receives a
value, nothing, or a failure.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from typing import Any, NamedTuple, Protocol

from detector.engine.counters import RuleCounters
from detector.engine.queries.queries import Queries
from detector.engine.scoping.scopes import Candidate
from wayside.expressions import Reason, Value
from wayside.rules import CompiledRule


class PluginCall(NamedTuple):
    """One evaluation of a plugin's signal."""

    rule: str
    signal: str
    subject: str
    """The text in events: `car1+car2~north`."""
    clients: tuple[str, ...]
    """The client, the two of a pair in order, or the fleet's members at this tick."""
    element: str | None
    """The element of `each`, if the rule has one."""


class PluginFailedError(Exception):
    """A plugin returned no value: it failed (Reason.ERROR), or it is not running (Reason.ABSENT); the text names the
    reason."""

    def __init__(self, reason: Reason, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class PluginHost(Protocol):
    """Runs the plugins of all rules. Called only by the thread that drives the engine."""

    def configure(self, rules: Sequence[CompiledRule], kept: Collection[str]) -> None:
        """Evaluate these rules from now on; those that are not in `kept` start without state."""

    def value(self, call: PluginCall, queries: Queries) -> Value:
        """The signal's value, None if it has none. Raises PluginFailedError."""

    def retain(self, rule: str, subjects: Collection[str]) -> None:
        """Keep the state of these subjects of the rule only: it was evaluated for no others."""

    def reset(self) -> None:
        """Time jumped: drop all state, because windows reset."""


class NoPlugins:
    """The host of an engine without plugins."""

    def configure(self, rules: Sequence[CompiledRule], kept: Collection[str]) -> None:
        """Nothing to prepare."""

    def value(self, call: PluginCall, queries: Queries) -> Value:
        """Raises PluginFailedError."""
        raise PluginFailedError(Reason.ABSENT, "this engine runs no plugins")

    def retain(self, rule: str, subjects: Collection[str]) -> None:
        """Nothing to drop."""

    def reset(self) -> None:
        """Nothing to drop."""


class PluginSignals:
    """Adds the values of plugins to the variables of a rule's conditions."""

    def __init__(self, host: PluginHost, queries: Callable[[], Queries]) -> None:
        """`queries` returns the view of the buffer at the tick."""
        self._host = host
        self._queries = queries
        self._subjects: dict[str, dict[str, tuple[str, ...]]] = {}
        """By rule, the subjects that may have state, each with its clients."""

    def configure(self, rules: Sequence[CompiledRule], kept: Collection[str]) -> None:
        """Evaluate these rules from now on; those that are not in `kept` start without state."""
        self._subjects = {rule: subjects for rule, subjects in self._subjects.items() if rule in kept}
        self._host.configure(rules, kept)

    def forget_clients(self, clients: Collection[str]) -> None:
        """Forget lost clients: drop the state of their subjects, also for rules that samples trigger."""
        for rule, subjects in self._subjects.items():
            left = {subject: of for subject, of in subjects.items() if not any(client in clients for client in of)}
            if len(left) < len(subjects):
                self._subjects[rule] = left
                self._host.retain(rule, left)

    def gap(self) -> None:
        """Time jumped: windows reset, and so do plugins."""
        self._subjects.clear()
        self._host.reset()

    def added(
        self, rule: CompiledRule, candidates: Iterable[Candidate], counters: RuleCounters, *, every_subject: bool
    ) -> Iterator[Candidate]:
        """The candidates with the values of the rule's plugin signals among their variables.

        `every_subject`: there are no other subjects, so state kept for others is dropped.
        """
        if not rule.plugins:
            yield from candidates
            return
        queries = self._queries()
        known = self._subjects.setdefault(rule.name, {})
        subjects: dict[str, tuple[str, ...]] = {}
        for candidate in candidates:
            known[candidate.subject.text] = subjects[candidate.subject.text] = candidate.subject.clients
            values = dict(self._values(rule, candidate, queries, counters))
            yield candidate._replace(variables={**candidate.variables, **values})
        if every_subject:
            self._subjects[rule.name] = subjects
            self._host.retain(rule.name, subjects)

    def _values(
        self, rule: CompiledRule, candidate: Candidate, queries: Queries, counters: RuleCounters
    ) -> Iterator[tuple[str, Value]]:
        subject = candidate.subject
        clients = subject.clients or tuple(member["client"] for member in _members(candidate))
        for plugin in rule.plugins:
            call = PluginCall(rule.name, plugin.name, subject.text, clients, subject.element)
            try:
                value = self._host.value(call, queries)
            except PluginFailedError as failure:
                counters.note(failure.reason, f"signal {plugin.name}: plugin {plugin.plugin}: {failure}")
                continue
            if value is None:
                counters.note(Reason.ABSENT, f"signal {plugin.name}: plugin {plugin.plugin} returned no value")
            else:
                yield plugin.name, value


def _members(candidate: Candidate) -> list[dict[str, Any]]:
    members: list[dict[str, Any]] = candidate.variables.get("members", [])
    return members
