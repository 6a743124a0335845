"""Scopes: which subjects a rule is evaluated for at a tick, and what its expressions see of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from detector.engine.buffer import Buffer
from detector.engine.clients import Clients, fresh_streams
from detector.engine.counters import RuleCounters
from detector.engine.episodes import Truth
from detector.engine.signals import Position, Signals
from wayside.expressions import UNKNOWN
from wayside.rules import ClientSubject, CompiledRule, PairSubject

Members = tuple[str, ...]
"""The clients of a subject: one, or two in order of their names."""

_FEW = 32
"""Up to so many clients, looking at every pair is faster than building a tree."""

_ROUNDING = 1 + 1e-9
"""The tree is asked for a little more than wanted, lest it round a pair away that is just within reach."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A subject to evaluate the rule for."""

    members: Members
    variables: Mapping[str, Any]
    """What the conditions see; what is unknown is left out."""
    near: Truth
    """Whether an episode may start; unknown for a pair of which one's position is."""


class Views:
    """What a rule sees of each client at one tick, computed when it is first asked for."""

    def __init__(
        self,
        rule: CompiledRule,
        now: int,
        clients: Clients,
        buffer: Buffer,
        signals: Signals,
        stale_after: Mapping[str, int | None],
        counters: RuleCounters,
    ) -> None:
        self._rule = rule
        self._now = now
        self._clients = clients
        self._buffer = buffer
        self._signals = signals
        self._stale_after = stale_after
        self._counters = counters
        self._views: dict[str, dict[str, Any]] = {}

    def of(self, client: str) -> dict[str, Any]:
        """client, labels, streams and the known signals."""
        view = self._views.get(client)
        if view is None:
            view = {
                "client": client,
                "labels": self._clients.labels(client),
                "streams": fresh_streams(client, self._stale_after, self._buffer, self._now),
            }
            for signal in self._rule.signals:
                value = self._signals.value(self._rule.name, signal, client, self._now, self._counters)
                if value is not UNKNOWN:
                    view[signal.name] = value
            self._views[client] = view
        return view

    def positions(self, subject: PairSubject) -> dict[str, Position]:
        """Where the clients are whose position is known, in metres."""
        found = {}
        for client in self._clients:
            position = self._signals.position(self._rule.name, subject.position, client, self._now, self._counters)
            if position is not None:
                found[client] = position
        return found


def candidates(rule: CompiledRule, views: Views, clients: Clients, pending: Iterable[Members]) -> Iterator[Candidate]:
    """The subjects to look at: all that may start an episode, and those that have one or are about to."""
    match rule.subject:
        case ClientSubject():
            for client in clients:
                yield Candidate((client,), views.of(client), near=True)
        case PairSubject() as subject:
            yield from _pairs(subject, views, clients, pending)


def _pairs(subject: PairSubject, views: Views, clients: Clients, pending: Iterable[Members]) -> Iterator[Candidate]:
    positions = views.positions(subject)
    near = set(near_pairs(positions, subject.within))
    known = {members for members in pending if all(member in clients for member in members)}
    for members in sorted(near | known):
        a, b = members
        variables: dict[str, Any] = {"a": _member(views, a, positions), "b": _member(views, b, positions)}
        placed = a in positions and b in positions
        if placed:
            variables["distance"] = math.dist(positions[a], positions[b])
        yield Candidate(members, variables, near=members in near if placed else UNKNOWN)


def _member(views: Views, client: str, positions: Mapping[str, Position]) -> dict[str, Any]:
    view = views.of(client)
    if client in positions and "position" not in view:
        view["position"] = dict(zip("xyz", positions[client], strict=True))
    return view


def near_pairs(positions: Mapping[str, Position], within: float) -> Iterator[tuple[str, str]]:
    """The pairs of names, each in order, that are at most `within` metres apart."""
    names = sorted(positions)
    if len(names) <= _FEW:
        for a, b in combinations(names, 2):
            if math.dist(positions[a], positions[b]) <= within:
                yield a, b
        return
    # Not at the top: it takes half a second to import, which a detector of few clients does not owe.
    from scipy.spatial import cKDTree  # noqa: PLC0415

    tree = cKDTree(np.array([positions[name] for name in names]))
    for i, j in tree.query_pairs(within * _ROUNDING):
        # The tree rounds in its own way; this is what expressions see as distance.
        if math.dist(positions[names[i]], positions[names[j]]) <= within:
            yield names[i], names[j]


def snapshot(rule: CompiledRule, candidate: Candidate) -> dict[str, Any]:
    """The values that go into the event: signals, positions and the distance, where known."""
    variables = candidate.variables
    if isinstance(rule.subject, ClientSubject):
        return _signals_of(rule, variables)
    values: dict[str, Any] = {}
    if "distance" in variables:
        values["distance"] = variables["distance"]
    for role in ("a", "b"):
        view = variables[role]
        values[role] = {"client": view["client"], **_signals_of(rule, view)}
        if "position" in view:
            values[role]["position"] = view["position"]
    return values


def _signals_of(rule: CompiledRule, view: Mapping[str, Any]) -> dict[str, Any]:
    return {signal.name: _without_bytes(view[signal.name]) for signal in rule.signals if signal.name in view}


def _without_bytes(value: Any) -> Any:
    """Neither an event nor a task can carry bytes, which CEL yields where it is asked to: null stands for them."""
    if isinstance(value, bytes):
        return None
    if isinstance(value, list):
        return [_without_bytes(item) for item in value]
    if isinstance(value, dict):
        return {key: _without_bytes(child) for key, child in value.items()}
    return value
