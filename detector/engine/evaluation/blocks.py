"""Rules in columns: which rules are evaluated together, and the ticks that wait for evaluation.

Rules that are due at the same ticks form a group. Ticks are collected as long as nothing happens between them that an
evaluation could see or change. The number of ticks evaluated together never changes a result.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from operator import attrgetter

from detector.engine.columns.block import Context
from detector.engine.columns.fleets import FleetGroup, fits_fleet
from detector.engine.columns.group import ClientGroup, fit_signals, fits_clients, signals_of
from detector.engine.columns.pairs import fits_pairs
from detector.engine.episodes.events import OrderedEvent
from detector.engine.evaluation.groups import RuleGroup
from detector.engine.evaluation.observing import Observer
from detector.engine.evaluation.pairs import PairGroup
from detector.engine.evaluation.rule import RuleRun
from detector.engine.timing.schedule import SubjectFilter
from wayside.rules import CompiledRule, episode_stream

_POINTS = 2_000_000
"""Maximum number of points, for all rules, ticks and clients, in a block: the columns of all rules are in memory."""


_place = attrgetter("time", "order", "event.episode.subject")


class Blocks:
    """All rules that are evaluated in columns."""

    def __init__(self, context: Context, floor: Callable[[], int | None], observer: Observer | None = None) -> None:
        """`floor`: windows start after this time; nanoseconds."""
        self._observer = observer
        self._context = context
        self._floor = floor
        self._depths: list[list[RuleGroup | PairGroup]] = []
        """Groups by depth: first those whose rules read no episodes of other rules, then those that read episodes of
        these, …"""
        self._groups: list[RuleGroup | PairGroup] = []
        self._ahead: list[OrderedEvent] = []
        """Events at ticks for which other groups have not been evaluated yet."""
        self._on_sample: dict[str, RuleGroup] = {}
        self.with_samples: Mapping[str, Sequence[RuleRun]] = {}
        """By stream, the rules that are evaluated on each sample of it."""
        self.hurries = False
        """Whether any group needs `run_ahead`."""
        self.names: frozenset[str] = frozenset()
        """The names of the rules that are evaluated here."""

    def set_rules(
        self, runs: Mapping[str, RuleRun], paused: Collection[str], thinning: Callable[[RuleRun], int]
    ) -> None:
        """Evaluate these rules from now on; `thinning`: only one in this number of a rule's evaluations takes place."""
        orders = {name: order for order, name in enumerate(runs)}
        depths: dict[str, int] = {}
        together: dict[tuple[int, type[ClientGroup | FleetGroup], int, int], list[RuleRun]] = {}
        by_stream: dict[str, list[RuleRun]] = {}
        pairs: list[tuple[int, RuleRun, int]] = []
        for run in runs.values():
            rule, every = run.rule, run.rule.every_ns
            if rule.name in paused or not rule.enabled or run.alone or not fit_signals(rule, self._context.tables):
                continue
            depth = self._depth(rule, depths)
            if depth is None:
                continue
            if every is None:
                if rule.on_sample is not None and fits_clients(rule) and not depth:
                    by_stream.setdefault(rule.on_sample, []).append(run)
                continue
            if fits_pairs(rule, self._context):
                pairs.append((depth, run, every))
            elif fits_clients(rule) or fits_fleet(rule):
                columns = ClientGroup if fits_clients(rule) else FleetGroup
                together.setdefault((depth, columns, every, every * thinning(run)), []).append(run)
            else:
                continue
            depths[rule.name] = depth
        self._context.tables.forget_users()
        self._depths = [[] for _ in range(max(depths.values(), default=-1) + 1)]
        for (depth, columns, every, period), chosen in together.items():
            self._depths[depth].append(RuleGroup(chosen, orders, self._context, every, period, columns))
        for depth, run, every in pairs:
            period = every * thinning(run)
            self._depths[depth].append(PairGroup(run, orders[run.rule.name], self._context, every, period))
        self._groups = [group for groups in self._depths for group in groups]
        self.hurries = any(not group.may_wait for groups in self._depths[:1] for group in groups)
        self._on_sample = {
            stream: RuleGroup(chosen, orders, self._context, 0, 0) for stream, chosen in by_stream.items()
        }
        self.with_samples = by_stream
        groups: list[RuleGroup | PairGroup] = [*self._groups, *self._on_sample.values()]
        self.names = frozenset(run.rule.name for group in groups for run in group.runs)
        for group in groups:
            group.observer = self._observer
            for run in group.runs:
                run.disturbed = True

    def _depth(self, rule: CompiledRule, depths: Mapping[str, int]) -> int | None:
        """The rule's depth: one more than that of the rules it reads; None: a rule that it reads is not evaluated
        here."""
        named = {signal.rule for signal in signals_of(rule) if signal.rule is not None}
        evaluated = {each for each in named if self._context.starts.is_evaluated(episode_stream(each))}
        if not evaluated <= depths.keys():
            return None
        return 1 + max((depths[each] for each in evaluated), default=0) if named else 0

    def due(self, time: int) -> list[RuleGroup | PairGroup]:
        """The groups that are evaluated at a tick."""
        return [group for group in self._groups if time % group.period == 0]

    def skip(self, time: int) -> None:
        """Count the evaluations that are skipped at a tick."""
        for group in self._groups:
            if group.period != group.every and time % group.every == 0 and time % group.period:
                for run in group.runs:
                    run.counters.skipped += 1

    def wait(self, time: int, groups: Iterable[RuleGroup | PairGroup]) -> bool:
        """Queue this tick of the groups. Returns whether enough points are queued to evaluate them now."""
        clients = len(self._context.clients)
        full = False
        ahead = self._depths[0] if self._depths else ()
        for group in groups:
            group.waiting.append(time)
            full = full or len(group.waiting) * max(clients, 1) * group.width > _POINTS
            full = full or not (group.may_wait or group in ahead)
        return full

    @property
    def waiting(self) -> bool:
        """Whether any queued tick is not evaluated yet."""
        return bool(self._ahead) or any(group.waiting for group in self._groups)

    @property
    def since(self) -> int:
        """The first queued tick; the queue must not be empty."""
        first = [group.waiting[0] for group in self._groups if group.waiting]
        return min([*first, *(each.time for each in self._ahead[:1])])

    def run_ahead(self, stopwatch: Callable[[], int]) -> None:
        """Evaluate the groups that take one tick at a time; the others wait. The next `run` returns the events."""
        clients = [*self._context.clients]
        for group in self._depths[0]:
            if group.waiting and not group.may_wait:
                ticks, group.waiting = group.waiting, []
                self._ahead += self._noted(self._evaluated(group, ticks, clients, stopwatch))

    def run(self, stopwatch: Callable[[], int]) -> list[OrderedEvent]:
        """Evaluate all queued ticks; returns the events, in order."""
        happened, self._ahead = self._ahead, []
        clients = [*self._context.clients]
        for groups in self._depths:
            found: list[OrderedEvent] = []
            for group in groups:
                if group.waiting:
                    ticks, group.waiting = group.waiting, []
                    found += self._evaluated(group, ticks, clients, stopwatch)
            happened += self._noted(found)
        happened.sort(key=_place)
        return happened

    def _noted(self, happened: list[OrderedEvent]) -> list[OrderedEvent]:
        """The same, after making them visible to rules that read episodes of other rules."""
        if self._context.starts.needed:
            happened.sort(key=_place)
            for each in happened:
                self._context.starts.note(each.event)
        return happened

    def run_with_samples(
        self,
        stream: str,
        time: int,
        clients: Sequence[str],
        only: Mapping[str, SubjectFilter],
        stopwatch: Callable[[], int],
    ) -> list[OrderedEvent]:
        """Evaluate the rules that are triggered by the samples of a stream, about these clients; `only` has the
        subjects of each rule."""
        group = self._on_sample[stream]
        return self._noted(self._evaluated(group, (time,), clients, stopwatch, only))

    def _evaluated(
        self,
        group: RuleGroup | PairGroup,
        ticks: Sequence[int],
        clients: Sequence[str],
        stopwatch: Callable[[], int],
        only: Mapping[str, SubjectFilter] | None = None,
    ) -> list[OrderedEvent]:
        """Evaluate a group at these ticks; the time spent is divided among its rules."""
        begin = stopwatch()
        found = group.evaluate(ticks, clients, self._floor(), only)
        spent = (stopwatch() - begin) // max(len(group.runs), 1)
        count, last = len(ticks), ticks[-1]
        for run in group.runs:
            run.counters.timed(last, spent, count)
        return found
