"""Scopes: which subjects a rule is evaluated for at a tick, and the variables of its expressions for each."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from detector.engine.buffering.buffer import Buffer
from detector.engine.buffering.clients import Clients, fresh_streams
from detector.engine.counters import RuleCounters
from detector.engine.episodes.episodes import Truth, both
from detector.engine.episodes.subjects import Subject
from detector.engine.samples.sample import Sample
from detector.engine.scoping.nearness import Search, near_pairs
from detector.engine.scoping.positions import Place, PositionLookup, described, distance, distance_of_order_1, point
from detector.engine.signals.models import add_models
from detector.engine.signals.signals import Signals
from detector.engine.timing.schedule import SubjectFilter
from wayside.expressions import UNKNOWN, Expression, Path, Reason, Unknown, Value
from wayside.rules import ClientSubject, CompiledElement, CompiledRule, CompiledSignal, FleetSubject, PairSubject

_NONE: frozenset[Path] = frozenset()

CLOSING_NS = 1_000_000_000
"""The period over which the closing speed is measured, in nanoseconds."""


class Candidate(NamedTuple):
    """A subject to evaluate the rule for."""

    subject: Subject
    variables: Mapping[str, Any]
    """The variables of the conditions; unknown ones are left out."""
    in_scope: Truth
    """Whether `where` and the roles of a pair hold; false ends an open episode."""
    near: Truth
    """Whether an episode may start; unknown for a pair if one position is unknown."""
    never: frozenset[Path] = frozenset()
    """The beginnings of the paths to signals that its clients can never have."""
    measured: Mapping[str, Any] = {}
    """By signal over the open episode, the value at this evaluation; unknown ones are left out."""


class Evaluated(NamedTuple):
    """The inputs and the result of a rule's evaluation for one subject. Times are nanoseconds."""

    now: int
    candidate: Candidate
    when: Truth
    until: Truth
    is_open: bool
    onset: int | None


class Views:
    """The variables of a rule for each client at one tick, computed on first use."""

    def __init__(
        self,
        rule: CompiledRule,
        now: int,
        clients: Clients,
        buffer: Buffer,
        signals: Signals,
        positions: PositionLookup,
        stale_after: Mapping[str, int | None],
        counters: RuleCounters,
        *,
        exact: bool = True,
    ) -> None:
        """`exact`: see `steps.ORDER`; False is order 1."""
        self._exact = exact
        self._rule = rule
        self._now = now
        self._clients = clients
        self._buffer = buffer
        self._signals = signals
        self._positions = positions
        self._stale_after = stale_after
        self._counters = counters
        self._common = rule.common_signals
        self._views: dict[str, dict[str, Any]] = {}
        self._of_elements: dict[tuple[str, str | None], dict[str, Any]] = {}
        self._earlier: dict[tuple[str, int], Place | None] = {}
        self._by_sample: dict[tuple[str, Sample | None], Place | None] = {}

    def of(self, client: str, element: CompiledElement) -> dict[str, Any]:
        """client, labels, streams and the known signals, including those that read the element."""
        if client not in self._views:
            self.prepare((client,))
        if not element.signals:
            return self._views[client]
        at = (client, element.name)
        if at not in self._of_elements:
            self._of_elements[at] = {**self._views[client], **self._values(element.signals, client)}
        return self._of_elements[at]

    def prepare(self, clients: Iterable[str]) -> None:
        """Prepare these clients together: models run once for all of them."""
        new = {client: self._new_view(client) for client in clients if client not in self._views}
        self._views.update(new)
        if self._rule.models and new:
            add_models(self._rule, new, self._now, self._signals, self._counters)

    def _new_view(self, client: str) -> dict[str, Any]:
        view: dict[str, Any] = {
            "client": client,
            "labels": self._clients.labels(client),
            "streams": fresh_streams(client, self._stale_after, self._buffer, self._now),
            "parameters": self._rule.parameters.of(client),
        }
        return {**view, **self._values(self._common, client)}

    def _values(self, signals: Iterable[CompiledSignal], client: str) -> dict[str, Any]:
        """The known values of the signals."""
        computed = {
            signal.name: self._signals.value(self._rule.name, signal, client, self._now, self._counters)
            for signal in signals
        }
        return {name: value for name, value in computed.items() if value is not UNKNOWN}

    def place(self, subject: PairSubject, client: str) -> Place | None:
        """The client's place, if known."""
        return self._positions.now(subject.position, client, self._now, self._counters)

    def distance(self, subject: PairSubject, one: Place, other: Place) -> float:
        """Metres between two places: the same number for conditions, reach and events."""
        return (distance if self._exact else distance_of_order_1)(subject.position, one, other)

    def closing_speed(self, subject: PairSubject, a: str, b: str, distance: float) -> float | None:
        """By how much the distance shrank in the last second for which both clients sent places, in m/s.

        `distance` is the current one. None while one of the places is unknown. A zero has no sign.
        """
        end = self._closing_end(subject, a, b)
        after = distance if end == self._now else self._distance_at(subject, a, b, end)
        before = self._distance_at(subject, a, b, end - CLOSING_NS)
        if after is None or before is None:
            return None
        speed = (before - after) / (CLOSING_NS / 1e9)
        return speed if self._exact or speed else -0.0

    def _closing_end(self, subject: PairSubject, a: str, b: str) -> int:
        """The end of the second over which the closing speed is measured."""
        order_1 = not self._exact
        return self._now if order_1 else self._positions.common_time(subject.position, (a, b), self._now)

    def _distance_at(self, subject: PairSubject, a: str, b: str, then: int) -> float | None:
        one, other = self._place_at(subject, a, then), self._place_at(subject, b, then)
        return None if one is None or other is None else self.distance(subject, one, other)

    def _place_at(self, subject: PairSubject, client: str, then: int) -> Place | None:
        """The client's place, if known; looked up once a tick for each time, and each sample read once."""
        at = (client, then)
        if at not in self._earlier:
            sample = self._positions.sample(subject.position, client, then, self._now)
            by = (client, sample)
            if by not in self._by_sample:
                self._by_sample[by] = self._positions.of(subject.position, client, sample, self._counters)
            self._earlier[at] = self._by_sample[by]
        return self._earlier[at]

    def truth(self, expression: Expression | None, variables: Mapping[str, Any], place: str) -> Truth:
        """The truth of a condition; an absent one is true. `place` names field and subject, for errors."""
        if expression is None:
            return True
        never = self.never(str(variables["client"])) if "client" in variables else frozenset()
        return condition(expression, variables, place, never, self._counters)

    def never(self, client: str, *role: str) -> frozenset[Path]:
        """The beginnings of the paths to signals that the client can never have, after a pair's role if given."""
        possible = self._signals.possible
        if not possible.limited:
            return _NONE
        return frozenset((*role, signal.name) for signal in self._rule.signals if not possible(signal.stream, client))

    def left_out(self, pairs: int) -> None:
        """Count pairs within reach that were left out."""
        self._counters.crowded_pairs += pairs


def condition(
    expression: Expression, variables: Mapping[str, Any], place: str, never: frozenset[Path], counters: RuleCounters
) -> Truth:
    """The truth of a condition. Counts an unknown result, unless the condition reads a signal that can never exist."""
    value = evaluated(expression, variables, place, never, counters)
    return value if isinstance(value, bool) else UNKNOWN


def evaluated(
    expression: Expression, variables: Mapping[str, Any], place: str, never: frozenset[Path], counters: RuleCounters
) -> Value | Unknown:
    """The value of an expression; counts an unknown result as `condition` does."""

    def note(reason: Reason, message: str) -> None:
        if (
            reason is Reason.ERROR
            or not never
            or not any(path[: len(each)] == each for path in expression.paths for each in never)
        ):
            counters.note(reason, message, place)

    return expression.evaluate_or_unknown(variables, note)


def candidates(
    rule: CompiledRule, views: Views, clients: Clients, pending: Iterable[Subject], only: SubjectFilter | None = None
) -> Iterator[Candidate]:
    """The subjects to evaluate: all that may start an episode, and those with an open or pending one.

    `only`: restricts them to the subjects that it contains.
    """
    if not isinstance(rule.subject, PairSubject):
        views.prepare(clients if only is None or isinstance(rule.subject, FleetSubject) else only.present(clients))
    match rule.subject:
        case ClientSubject() as each:
            chosen = clients if only is None else only.present(clients)
            for element in rule.elements:
                for client in chosen:
                    if only is not None and not only.contains(Subject((client,), element.name)):
                        continue
                    variables = _with(views, client, element)
                    in_scope = views.truth(each.where, variables, f"where of {client}")
                    never = views.never(client)
                    yield Candidate(Subject((client,), element.name), variables, in_scope, near=True, never=never)
        case PairSubject() as pairs:
            yield from _pairs(rule, pairs, views, clients, pending, only)
        case FleetSubject() as fleet:
            for element in rule.elements:
                if only is not None and not only.contains(Subject((), element.name)):
                    continue
                seen = ((client, _with(views, client, element)) for client in clients)
                members = [
                    views.of(client, element)
                    for client, view in seen
                    if views.truth(fleet.members, view, f"members of {client}") is True
                ]
                yield Candidate(
                    Subject((), element.name),
                    {"members": members, "parameters": rule.parameters.own, **element.variables},
                    in_scope=True,
                    near=True,
                )


def _with(views: Views, client: str, element: CompiledElement) -> dict[str, Any]:
    """The variables about one client, and the element."""
    view = views.of(client, element)
    return {**view, **element.variables} if element.variables else view


def _pairs(
    rule: CompiledRule,
    subject: PairSubject,
    views: Views,
    clients: Clients,
    pending: Iterable[Subject],
    only: SubjectFilter | None,
) -> Iterator[Candidate]:
    places = {client: place for client in clients if (place := views.place(subject, client)) is not None}
    points = {client: point(subject.position, place) for client, place in places.items()}

    def between(a: str, b: str) -> float:
        return views.distance(subject, places[a], places[b])

    in_progress = {each for each in pending if all(client in clients for client in each.clients)}
    for element in rule.elements:
        a_truth = _role(subject.a, element, views, clients)
        b_truth = _role(subject.b, element, views, clients)
        roles = (None, None) if not subject.ordered else (_possible(a_truth), _possible(b_truth))
        found = near_pairs(Search(points, between, *roles), subject.within, subject.maximum)
        views.left_out(found.left_out)
        near = {Subject(pair, element.name) for pair in found.pairs}
        chosen = sorted(near | {one for one in in_progress if one.element == element.name})
        if only is not None:
            chosen = [each for each in chosen if only.contains(each)]
        views.prepare(dict.fromkeys(client for each in chosen for client in each.clients))
        for each in chosen:
            a, b = each.clients
            variables: dict[str, Any] = {
                "a": _member(views, subject, a, places, element),
                "b": _member(views, subject, b, places, element),
                "parameters": rule.parameters.own,
                **element.variables,
            }
            placed = a in places and b in places
            if placed:
                variables["distance"] = between(a, b)
                if subject.closing_speed:
                    speed = views.closing_speed(subject, a, b, variables["distance"])
                    variables |= {} if speed is None else {"closingSpeed": speed}
            in_scope = both(
                both(a_truth[a], b_truth[b]), views.truth(subject.where, variables, f"where of {each.text}")
            )
            never = views.never(a, "a") | views.never(b, "b")
            yield Candidate(each, variables, in_scope, near=each in near if placed else UNKNOWN, never=never)


def _role(where: Expression | None, element: CompiledElement, views: Views, clients: Clients) -> dict[str, Truth]:
    """By client, whether it can have the role."""
    if where is None:
        return dict.fromkeys(clients, True)
    return {
        client: views.truth(where, _with(views, client, element), f"where of a or b for {client}") for client in clients
    }


def _possible(role: Mapping[str, Truth]) -> list[str]:
    """The clients that have the role, or may have it."""
    return [client for client, truth in role.items() if truth is not False]


def _member(
    views: Views, subject: PairSubject, client: str, places: Mapping[str, Place], element: CompiledElement
) -> dict[str, Any]:
    view = views.of(client, element)
    if client in places and "position" not in view:
        view["position"] = described(subject.position, places[client])
    return view
