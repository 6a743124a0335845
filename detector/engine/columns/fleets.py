"""Rules about the fleet in columns: which clients are members, and conditions over all of them.

Loops over the members become folds: a predicate at each point, reduced over the clients of a tick. CEL evaluates
conditions with other loops, and ticks that the columns cannot decide.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from detector.engine.columns.block import Block, Context, Track
from detector.engine.columns.client_values import ClientValues
from detector.engine.columns.conditions import Conditions
from detector.engine.columns.group import present
from detector.engine.columns.reading import constant
from detector.engine.columns.signals import SignalColumns
from detector.engine.columns.table import Integers, Truths
from detector.engine.columns.verdicts import Codes, Ternary, observed
from detector.engine.episodes.subjects import FLEET, Subject
from wayside.expressions import Expression, Path
from wayside.expressions.columns.folds import Fold, FoldKind, folded
from wayside.expressions.columns.lowering import Constant, Graph
from wayside.expressions.columns.program import Program, Results
from wayside.expressions.columns.values import Column, Tag, stacked
from wayside.rules import CompiledRule, FleetSubject

_MEMBERS = "members"


def fits_fleet(rule: CompiledRule) -> bool:
    """Whether a rule about the fleet can be evaluated in columns; its signals are known to fit."""
    budgeted = rule.maximum_per_hour is not None and len(rule.elements) > 1
    return isinstance(rule.subject, FleetSubject) and not budgeted and not rule.derived


class FleetCondition(NamedTuple):
    """One of a rule's conditions about the fleet, for one element."""

    expression: Expression
    node: int | None
    """The node of its truth over the ticks; None: CEL evaluates the condition."""
    folds: Mapping[str, tuple[FoldKind, int | None]]
    """By leaf, how it is folded, and the truth of its predicate over the points; None: all members count."""


class FleetBlock:
    """The values of the fleet that rules read at some ticks. It has the interface of a `Block` with one client, the
    fleet."""

    clients = (FLEET,)
    numbers: Integers = np.zeros(1, np.int64)
    present = None

    def __init__(self, block: Block, members: Truths) -> None:
        """`members`: which clients are members, by track and point; shape (tracks, clients, ticks)."""
        self.ticks = block.ticks
        self.times = block.times
        self.of_clients = block
        self.members = members
        self.verdicts: list[Mapping[str, Ternary]] = []
        """By track and field, where conditions are true and false; shape (ticks,)."""

    def variables(self, track: Track, point: int) -> dict[str, Any]:
        """The variables of expressions at a tick, as in `scopes`."""
        block, count = self.of_clients, len(self.ticks)
        chosen = np.flatnonzero(self.members[track.row, :, point]).tolist()
        return {
            _MEMBERS: [block.view(track, client * count + point) for client in chosen],
            "parameters": track.rule.parameters.own,
            **track.element.variables,
        }


class FleetGroup:
    """The rules about the fleet that are evaluated at the same ticks."""

    needs_clients = False
    room = 1

    def __init__(self, tracks: Sequence[Track], context: Context) -> None:
        """All rules fit (see `fits_fleet`)."""
        self.tracks = tracks
        self._context = context
        self._signals = SignalColumns(context, tracks)
        if any(_reads_streams(track.rule) for track in tracks):
            self._signals.watch_all_streams()
        self._client_values = ClientValues(context, tracks)
        self._members = Conditions(context, tracks, _members)
        self._of_points, self._of_ticks = Graph(), Graph()
        self._of = [
            {field: self._condition(track, field, each) for field, each in _conditions(track.rule).items()}
            for track in tracks
        ]
        conditions = [each for of_one in self._of for each in of_one.values()]
        texts = context.tables.texts
        self._inner = Program(
            self._of_points,
            [node for each in conditions for _, node in each.folds.values() if node is not None],
            texts,
        )
        self._outer = Program(self._of_ticks, [each.node for each in conditions if each.node is not None], texts)

    def number(self, subject: Subject) -> int:
        """The number of a subject among those of its rule and element: always 0, because the fleet is the only one."""
        return 0

    def _condition(self, track: Track, field: str, expression: Expression) -> FleetCondition:
        rest, folds = folded(expression, _MEMBERS)
        of_points, of_ticks = len(self._of_points.nodes), len(self._of_ticks.nodes)
        found: dict[str, tuple[FoldKind, int | None]] = {}
        for name, fold in folds.items():
            node = None
            if fold.predicate is not None:
                lowered = self._of_points.add(fold.predicate, partial(self._inside, track, fold))
                if lowered is None:
                    self._of_points.forget(of_points)
                    return FleetCondition(expression, None, {})
                node = self._of_points.truth(lowered)
            found[name] = (fold.kind, node)
        lowered = self._of_ticks.add(rest, partial(self._outside, track, field, found))
        if lowered is None:
            self._of_points.forget(of_points)
            self._of_ticks.forget(of_ticks)
            return FleetCondition(expression, None, {})
        return FleetCondition(expression, self._of_ticks.truth(lowered), found)

    def _inside(self, track: Track, fold: Fold, path: Path) -> Hashable | Constant | None:
        """The leaf of a path in a predicate."""
        if path[0] == fold.variable:
            return self._client_values.of_client(track, path[1:]) if len(path) > 1 else None
        return self._own(track, path)

    def _outside(self, track: Track, field: str, folds: Mapping[str, object], path: Path) -> Hashable | Constant | None:
        """The leaf of a path outside of predicates."""
        return (track.row, field, path[0]) if path[0] in folds else self._own(track, path)

    def _own(self, track: Track, path: Path) -> Constant | None:
        """A leaf that is a parameter of the rule, or the element."""
        return constant({"parameters": track.rule.parameters.own, **track.element.variables}, path)

    def evaluate(
        self, ticks: Sequence[int], clients: Sequence[str], floor: int | None, selected: Truths | None = None
    ) -> tuple[FleetBlock, Codes]:
        """The rules' observations at the ticks: uint8, shape (tracks, 1, ticks). They read all clients.

        Windows start after `floor`. Counts unknown values and failures.
        """
        assert selected is None  # noqa: S101  such rules are not evaluated with samples
        block = Block(self._context, ticks, clients)
        members = np.zeros((len(self.tracks), *block.shape), bool)
        if clients:
            block.present = present(block, self._context.clients)
            self._signals.compute(block, floor)
            members = self._members.verdicts(block)[_PLACE].true.reshape(members.shape)
            if block.present is not None:
                members = members & block.present
        fleet = FleetBlock(block, members)
        for track in self.tracks:
            track.counters.evaluations += len(ticks)
        return fleet, self._observed(fleet)

    def _observed(self, fleet: FleetBlock) -> Codes:
        block, count = fleet.of_clients, len(fleet.ticks)
        inner: Results | None = None
        if block.clients:
            points = len(block.clients) * count
            inner = self._inner.run(
                *stacked([self._client_values.at_points(block, each) for each in self._inner.leaves], points)
            )
        columns = [self._fold(fleet, inner, leaf) for leaf in self._outer.leaves]
        outer = self._outer.run(*stacked(columns, count))
        codes = np.empty((len(self.tracks), 1, count), np.uint8)
        for row, conditions in enumerate(self._of):
            verdicts = {field: self._verdict(fleet, row, field, inner, outer) for field in conditions}
            fleet.verdicts.append(verdicts)
            when = verdicts["when"]
            codes[row, 0] = observed(when, verdicts.get("until", Ternary(when.false, when.true)))
        return codes

    def _fold(self, fleet: FleetBlock, inner: Results | None, leaf: Any) -> Column:
        """A fold at each tick."""
        row, field, name = leaf
        how, node = self._of[row][field].folds[name]
        members = fleet.members[row]
        if node is None or inner is None:
            true, unknown = members, np.zeros(members.shape, bool)
        else:
            all_true, all_false = (each[0].reshape(members.shape) for each in inner.truths([node]))
            true, unknown = members & all_true, members & ~(all_true | all_false)
        some, unsure = true.any(axis=0), unknown.any(axis=0)
        if how is FoldKind.COUNT:
            values, tag = true.sum(axis=0).astype(float), Tag.NUMBER
        elif how is FoldKind.ANY:
            values, tag, unsure = some.astype(float), Tag.BOOLEAN, unsure & ~some
        else:
            against = (members & ~true & ~unknown).any(axis=0)
            values, tag, unsure = (~against).astype(float), Tag.BOOLEAN, unsure & ~against
        return Column(np.where(unsure, 0.0, values), np.where(unsure, Tag.ABSENT, tag).astype(np.uint8))

    def _verdict(self, fleet: FleetBlock, row: int, field: str, inner: Results | None, outer: Results) -> Ternary:
        condition, count = self._of[row][field], len(fleet.ticks)
        if condition.node is None:
            verdict = Ternary(np.zeros(count, bool), np.zeros(count, bool))
            kinds = self._kinds(fleet, row, exact=True)
        else:
            true, false = outer.truths([condition.node])
            verdict = Ternary(true[0].copy(), false[0].copy())
            strange = self._strange(fleet, row, condition, inner, outer)
            kinds = np.where(strange, self._kinds(fleet, row, exact=True), -1) if strange.any() else np.full(count, -1)
            unknown = ~(verdict.true | verdict.false) & ~strange
            if unknown.any():
                kinds = np.where(unknown, int(kinds.max()) + 1 + self._kinds(fleet, row, exact=False), kinds)
        self._evaluate_by_cel(fleet, row, field, kinds, verdict)
        return verdict

    def _strange(
        self, fleet: FleetBlock, row: int, condition: FleetCondition, inner: Results | None, outer: Results
    ) -> Truths:
        """The ticks that the columns cannot decide."""
        assert condition.node is not None  # noqa: S101  only conditions in columns come here
        found = np.zeros(len(fleet.ticks), bool)
        if (cel_rows := outer.cel_rows(condition.node)) is not None:
            found |= cel_rows
        for _, node in condition.folds.values() if inner is not None else ():
            if node is not None and inner is not None and (cel_rows := inner.cel_rows(node)) is not None:
                found |= (cel_rows.reshape(fleet.members[row].shape) & fleet.members[row]).any(axis=0)
        return found

    def _kinds(self, fleet: FleetBlock, row: int, *, exact: bool) -> Integers:
        """A number for each tick. Ticks with equal numbers have the same inputs, or, if not `exact`, inputs of the same
        types."""
        block, members = fleet.of_clients, fleet.members[row]
        count = len(fleet.ticks)
        rows: list[NDArray[np.int64]] = [members.astype(np.int64)]
        rows += [fresh.astype(np.int64) for fresh in block.fresh.values()]
        if block.clients:
            for at in self.tracks[row].signals.values():
                column = block.signals[at]
                tags = np.full(block.shape, Tag.NUMBER) if column.tags is None else column.tags.reshape(block.shape)
                rows.append(tags.astype(np.int64))
                if exact:
                    rows.append(column.values.reshape(block.shape).view(np.int64))
                    if (tags == Tag.OTHER).any():  # a list may differ although its tag does not
                        rows.append(np.where(tags == Tag.OTHER, np.arange(count), 0))
        seen = np.concatenate(rows)
        if not len(seen):
            return np.zeros(count, np.int64)
        _, kinds = np.unique(seen, axis=1, return_inverse=True)
        found: Integers = kinds.reshape(count)
        return found

    def _evaluate_by_cel(self, fleet: FleetBlock, row: int, field: str, kinds: Integers, verdict: Ternary) -> None:
        """Evaluate a condition by CEL, once for the ticks of each kind; ticks of a negative kind are already
        decided."""
        track, expression = self.tracks[row], self._of[row][field].expression
        place = f"{field} of {track.subject(FLEET).text}{track.place.get(field, '')}"
        last = {kind: at for at, kind in enumerate(kinds.tolist()) if kind >= 0}
        for kind, at in sorted(last.items(), key=lambda each: each[1]):
            value, note = expression.explained(fleet.variables(track, at))
            alike = kinds == kind
            verdict.true[alike], verdict.false[alike] = value is True, value is False
            if note is not None:
                track.counters.note(*note, place, int(alike.sum()))


_PLACE = "members"
"""For errors such as "members of car1"."""


def _members(rule: CompiledRule) -> Mapping[str, Expression]:
    assert isinstance(rule.subject, FleetSubject)  # noqa: S101  it fits
    return {_PLACE: rule.subject.members}


def _conditions(rule: CompiledRule) -> Mapping[str, Expression]:
    return {"when": rule.when} if rule.until is None else {"when": rule.when, "until": rule.until}


def _reads_streams(rule: CompiledRule) -> bool:
    """Whether any expression of the rule may read the freshness of streams."""
    templates = [
        *(deploy.parameters for deploy in rule.deploys),
        *(template for action in rule.actions for template in action.templates.values()),
    ]
    return any("streams" in each.source for each in (*_conditions(rule).values(), *_members(rule).values())) or any(
        _MEMBERS in template.names for template in templates
    )
