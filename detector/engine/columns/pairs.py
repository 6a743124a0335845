"""A rule about pairs at one tick, in columns: from places to an observation of each relevant pair."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from detector.engine.columns.block import Block, Context, Track
from detector.engine.columns.client_values import ClientValues
from detector.engine.columns.derived import DerivedColumns
from detector.engine.columns.earlier import Evaluations
from detector.engine.columns.formulas import Formulas, Rows
from detector.engine.columns.nearby import ClientPositions, Nearby, nearby
from detector.engine.columns.places import Places, PositionColumns
from detector.engine.columns.reading import constant
from detector.engine.columns.signals import SignalColumns
from detector.engine.columns.table import Integers, Truths, find_rows, sorted_rows
from detector.engine.columns.tables import Tables
from detector.engine.columns.verdicts import Codes, Ternary, observed
from detector.engine.episodes.subjects import Subject
from detector.engine.scoping.positions import described
from detector.engine.scoping.scopes import CLOSING_NS
from wayside.expressions import UNKNOWN, Expression, Path, Reason
from wayside.expressions.columns.lowering import Constant
from wayside.expressions.columns.values import Column, Doubles, Tag, value_at
from wayside.rules import CompiledRule, PairSubject

_ROLES = ("a", "b")


def fits_pairs(rule: CompiledRule, context: Context) -> bool:
    """Whether a rule about pairs can be evaluated in columns; its signals are known to fit."""
    return (
        isinstance(rule.subject, PairSubject)
        and context.exact
        and len(rule.elements) == 1
        and _supports(rule.subject.position.stream, context.tables)
    )


def _supports(stream: str, tables: Tables) -> bool:
    return any(each.name == stream and tables.supports(each) for each in tables.streams)


@dataclass
class PairBlock:
    """The pairs that a rule evaluates at one tick, in order of their names, with their observations."""

    block: Block
    """The clients, in order of their names, at the tick."""
    places: Places
    seen: Block
    """The clients whose signals are known, and their indices."""
    at: Integers
    first: Integers
    second: Integers
    """The clients of the pairs, by their indices in the block."""
    distance: Doubles
    placed: Truths
    closing: Doubles | None = None
    closing_known: Truths | None = None
    codes: Codes = field(default_factory=lambda: np.zeros(0, np.uint8))
    """The observation of each pair (see SubjectState.run)."""
    derived: dict[str, Column] = field(default_factory=dict)
    """The signals over other signals, of each pair."""
    measured: dict[str, Column] = field(default_factory=dict)
    """By signal over the open episode, the values that it aggregates."""
    verdicts: Mapping[str, Ternary] = field(default_factory=dict)
    """By field, where conditions are true and where false."""


class PairColumns:
    """Evaluates one rule about pairs."""

    def __init__(self, track: Track, context: Context) -> None:
        """The rule fits (see `fits_pairs`)."""
        rule = track.rule
        assert isinstance(rule.subject, PairSubject)  # noqa: S101  it fits
        self._subject = rule.subject
        self._track = track
        self._context = context
        self._signals = SignalColumns(context, [track], shared=False)
        if _reads_streams(rule):
            self._signals.watch_all_streams()
        self._plain = not rule.has_actions
        """Its events contain only signals, and it renders nothing."""
        self._reads_streams = bool(rule.signals) or _reads_streams(rule)
        self._positions = PositionColumns(rule.subject.position, context, track.counters, self._signals.ages)
        self._client_values = ClientValues(context, [track])
        self._derived_names = frozenset(signal.name for signal in rule.derived if not signal.episode)
        texts = context.tables.texts
        self._roles = {
            role: Formulas({"where": where}, lambda path: self._client_values.leaf(track, path), texts)
            for role, where in zip(_ROLES, (rule.subject.a, rule.subject.b), strict=True)
        }
        conditions = {"where": rule.subject.where, "when": rule.when, "until": rule.until}
        self._conditions = Formulas(conditions, self._leaf, texts)
        self._derived = DerivedColumns(track, self._leaf, context) if rule.derived else None
        self._numbers: tuple[Sequence[str], int, Integers] = ((), -1, np.zeros(0, np.int64))
        """Clients, the version of their numbers for signals over others, and the numbers."""

    def evaluate(self, block: Block, floor: int | None, more: tuple[Integers, Integers]) -> PairBlock:
        """Evaluate the pairs within reach and `more`, at the block's only tick; its clients are in order.

        `more` are indices of clients. Windows start after `floor`. Counts unknown values and failures.
        """
        clients = block.clients
        places, newest = self._positions.now(block)
        seen, at = block, np.arange(len(clients))
        roles: Mapping[str, Ternary] = {}
        if any(self._roles.values()):
            self._signals.compute(block, floor)
            roles = {role: self._role(role, block) for role in _ROLES}
        near = self._near(block, places, roles)
        self._track.counters.crowded_pairs += near.left_out
        count = len(clients)
        keys = near.first * count + near.second
        added = sorted_rows(more[0] * count + more[1])
        where, known = find_rows(keys, added)
        where, added = where[~known], added[~known]
        first, second = np.divmod(np.insert(keys, where, added), count)
        is_near = np.insert(np.ones(len(keys), bool), where, False)
        distance = np.insert(near.distance, where, self._distances(places, added // count, added % count))
        if not roles and self._reads_streams:
            paired = np.flatnonzero(np.bincount(np.concatenate((first, second)), minlength=count))
            at = np.full(count, -1)
            at[paired] = np.arange(len(paired))
            names = [clients[each] for each in paired.tolist()]
            seen = Block(self._context, block.ticks, names, block.numbers[paired])
            self._signals.compute(seen, floor)
        these = PairBlock(block, places, seen, at, first, second, distance, places.known[first] & places.known[second])
        if self._subject.closing_speed:
            self._measure_closing(these, newest, floor)
        self._track.counters.evaluations += len(first)
        if self._derived is not None:
            self._derive(these, self._derived)
        these.codes = self._observed(these, is_near, roles)
        return these

    def _derive(self, these: PairBlock, derived: DerivedColumns) -> None:
        earlier, clients, tick = self._track.earlier, these.block.clients, these.block.ticks[0]
        if self._numbers[0] is not clients or self._numbers[1] != earlier.version:
            own = np.array([earlier.number(client) for client in clients], np.int64)
            self._numbers = clients, earlier.version, own
        numbers = self._numbers[2]
        keys = earlier.pairs(numbers[these.first], numbers[these.second])
        now = Evaluations(keys, np.full(len(keys), tick), tick)
        expressions = {signal.name: signal.of for signal in self._track.rule.derived}
        for each in derived.compute(self._rows(these, expressions), now):
            columns = these.measured if each.signal.episode else these.derived
            columns[each.signal.name] = each.column

    def measured(self, these: PairBlock, row: int) -> dict[str, Any]:
        """The known values of one pair that signals over the open episode aggregate."""
        return self._known(these.measured, row)

    def _known(self, columns: Mapping[str, Column], row: int) -> dict[str, Any]:
        found = {name: value_at(column, row, self._context.tables.texts) for name, column in columns.items()}
        return {name: value for name, value in found.items() if value is not UNKNOWN}

    def variables(self, these: PairBlock, row: int) -> dict[str, Any]:
        """The variables of expressions about a pair, as in `scopes`."""
        found = self._pair(these, row, lambda at: these.seen.view(self._track, at))
        return {"parameters": self._track.rule.parameters.own, **self._track.element.variables, **found}

    def happened(self, these: PairBlock, row: int) -> dict[str, Any]:
        """The variables that the event of a pair, and the rule's actions, read."""
        if not self._plain:
            return self.variables(these, row)
        seen, track = these.seen, self._track
        return self._pair(these, row, lambda at: {"client": seen.clients[at], **seen.values(track, at)})

    def _pair(self, these: PairBlock, row: int, view: Callable[[int], dict[str, Any]]) -> dict[str, Any]:
        """The known values of a pair; `view` gives the variables of a client, by its index in `these.seen`."""
        found: dict[str, Any] = {}
        for role, each in (("a", these.first), ("b", these.second)):
            index = each.item(row)
            found[role] = view(these.at.item(index))
            if these.places.known.item(index):
                found[role]["position"] = described(self._subject.position, these.places.place(index))
        if these.placed.item(row):
            found["distance"] = these.distance.item(row)
        if these.closing is not None and these.closing_known is not None and these.closing_known.item(row):
            found["closingSpeed"] = these.closing.item(row)
        if these.derived:
            found.update(self._known(these.derived, row))
        return found

    def _distances(self, places: Places, one: Integers, other: Integers) -> Doubles:
        return self._positions.distances(places.of(one), places.of(other))

    def _near(self, block: Block, places: Places, roles: Mapping[str, Ternary]) -> Nearby:
        possible = [places.known & ~roles[role].false if role in roles else places.known for role in _ROLES]
        clients = ClientPositions(
            block.clients,
            lambda at: self._positions.points(places, at),
            lambda one, other: self._distances(places, one, other),
            *possible,
        )
        return nearby(clients, self._subject)

    def _measure_closing(self, these: PairBlock, newest: Integers, floor: int | None) -> None:
        """By how much the distances shrank in the last second for which both clients sent places: see `Views`."""
        at = np.flatnonzero(these.placed)
        one, other = these.first[at], these.second[at]
        now, positions = int(these.block.times[0]), self._positions
        if self._context.positions.limit(self._subject.position) is None:
            end = np.full(len(at), now)
        else:
            end = np.minimum(positions.times(newest[one]), positions.times(newest[other]))
        before = end != now
        times = np.concatenate((end[before], end[before], end - CLOSING_NS, end - CLOSING_NS))
        whose = np.concatenate((one[before], other[before], one, other))
        places = positions.then(these.block, newest, whose, times, floor)
        parts = np.cumsum([before.sum(), before.sum(), len(at)])
        a_end, b_end, a_begin, b_begin = (places.of(each) for each in np.split(np.arange(len(times)), parts))
        after, known = these.distance[at].copy(), a_begin.known & b_begin.known
        after[before] = positions.distances(a_end, b_end)
        known[before] &= a_end.known & b_end.known
        these.closing, these.closing_known = (
            np.zeros(len(these.placed)),
            np.zeros(len(these.placed), bool),
        )
        these.closing[at] = (positions.distances(a_begin, b_begin) - after) / (CLOSING_NS / 1e9)
        these.closing_known[at] = known

    # Conditions

    def _role(self, role: str, block: Block) -> Ternary:
        """Which clients can have the role."""

        def note(_: str, row: int, reason: Reason, message: str, times: int) -> None:
            client = block.clients[row]
            condition = getattr(self._subject, role)
            if reason is Reason.ERROR or not self._never(client) & {str(path[0]) for path in condition.paths}:
                self._track.counters.note(reason, message, f"where of a or b for {client}", times)

        rows = Rows(
            len(block.clients),
            lambda leaf: self._client_values.column(block, leaf),
            lambda row: {**block.view(self._track, row), **self._track.element.variables},
            note,
            not self._context.possible.limited,
        )
        everybody = Ternary(np.ones(rows.size, bool), np.zeros(rows.size, bool))
        return self._roles[role].evaluate(rows).get("where", everybody)

    def _rows(self, these: PairBlock, expressions: Mapping[str, Expression | None]) -> Rows:
        """The pairs as rows; `expressions` are the ones evaluated over them, by their names in errors."""

        def note(field: str, row: int, reason: Reason, message: str, times: int) -> None:
            a, b = self._names(these, row)
            if reason is Reason.ABSENT and self._context.possible.limited:
                never = {("a", name) for name in self._never(a)} | {("b", name) for name in self._never(b)}
                expression = expressions[field]
                if expression is not None and any(path[:2] in never for path in expression.paths):
                    return
            text = Subject((a, b), self._track.element.name).text
            place = f"{field} of {text}{self._track.place.get(field, '')}"
            self._track.counters.note(reason, message, place, times)

        return Rows(
            len(these.first),
            lambda leaf: self._pair_column(these, leaf),
            lambda row: self.variables(these, row),
            note,
            not self._context.possible.limited,
        )

    def _observed(self, these: PairBlock, near: Truths, roles: Mapping[str, Ternary]) -> Codes:
        conditions = {"where": self._subject.where, "when": self._track.rule.when, "until": self._track.rule.until}
        rows = self._rows(these, conditions)
        found = these.verdicts = self._conditions.evaluate(rows)
        when = found["when"]
        until = found.get("until", Ternary(when.false, when.true))
        inside, outside = np.ones(rows.size, bool), np.zeros(rows.size, bool)
        scope = [found["where"]] if "where" in found else []
        for role, at in zip(_ROLES, (these.first, these.second), strict=True):
            if role in roles:
                scope.append(Ternary(roles[role].true[at], roles[role].false[at]))
        for each in scope:
            inside &= each.true
            outside |= each.false
        return observed(when, until, Ternary(inside, outside), Ternary(near, these.placed & ~near))

    def _names(self, these: PairBlock, row: int) -> tuple[str, str]:
        return these.block.clients[int(these.first[row])], these.block.clients[int(these.second[row])]

    def _never(self, client: str) -> set[str]:
        """The signals that the client can never have."""
        possible = self._context.possible
        return {signal.name for signal in self._track.rule.signals if not possible(signal.stream, client)}

    # Leaves

    def _leaf(self, path: Path) -> Hashable | Constant | None:
        """The leaf of a path of a condition about pairs."""
        name, below = str(path[0]), path[1:]
        if name in self._track.element.variables:
            return constant(self._track.element.variables, path)
        if name in ("distance", "closingSpeed"):
            return None if below else (name,)
        if name in self._derived_names:
            return None if below else ("derived", name)
        if name == "parameters":
            return constant({"parameters": self._track.rule.parameters.own}, path)
        if name not in _ROLES or not below:
            return None
        if below[0] == "position":
            return path if len(below) == 2 and below[1] in (*self._subject.position.axes, "z") else None
        found = self._client_values.of_client(self._track, below)
        return found if found is None or isinstance(found, Constant) else (name, found)

    def _pair_column(self, these: PairBlock, leaf: Any) -> Column:
        if leaf == ("distance",):
            return _where(these.distance, these.placed)
        if leaf == ("closingSpeed",):
            assert these.closing is not None  # noqa: S101  an expression needs it
            assert these.closing_known is not None  # noqa: S101
            return _where(these.closing, these.closing_known)
        if leaf[0] == "derived":
            return these.derived[leaf[1]]
        at = these.first if leaf[0] == "a" else these.second
        if leaf[1] == "position":
            places = these.places.of(at)
            axes = [*self._subject.position.axes]
            values = places.axes[axes.index(leaf[2])] if leaf[2] in axes else np.zeros(len(at))
            return Column(values, np.where(places.known, np.uint8(Tag.NUMBER), np.uint8(Tag.UNREACHABLE)))
        whole, rows = self._client_values.column(these.seen, leaf[1]), these.at[at]
        return Column(
            whole.values[rows],
            None if whole.tags is None else whole.tags[rows],
            None if whole.others is None else whole.others[rows],
        )


def _where(values: Doubles, known: Truths) -> Column:
    tags = None if known.all() else np.where(known, np.uint8(Tag.NUMBER), np.uint8(Tag.ABSENT))
    return Column(values, tags)


def _reads_streams(rule: CompiledRule) -> bool:
    """Whether any expression of the rule may read the freshness of streams."""
    subject = rule.subject
    assert isinstance(subject, PairSubject)  # noqa: S101  the rule fits
    roles = {path for each in (subject.a, subject.b) if each is not None for path in each.paths}
    read = {path for each in (subject.where, rule.when, rule.until) if each is not None for path in each.paths}
    read |= {path for each in rule.derived if each.of is not None for path in each.of.paths}
    read |= {path for deploy in rule.deploys for path in deploy.parameters.paths}
    read |= {path for action in rule.actions for template in action.templates.values() for path in template.paths}
    return any(path[0] == "streams" for path in roles) or any(
        path[0] in _ROLES and (len(path) == 1 or path[1] == "streams") for path in read
    )
