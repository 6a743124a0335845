"""The evaluation of one rule: the states of its subjects, tick by tick, and its open episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from detector.engine.buffering.clients import Clients
from detector.engine.columns.derived import with_derived
from detector.engine.columns.earlier import EarlierValues
from detector.engine.counters import RuleCounters
from detector.engine.episodes.current import Budget, DetectorIdentity, EpisodeState, new_record
from detector.engine.episodes.demands import Demand, DemandChange
from detector.engine.episodes.episodes import (
    Ended,
    EndReason,
    Observation,
    Started,
    SubjectState,
    Timing,
    Truth,
    negation,
)
from detector.engine.episodes.events import Event
from detector.engine.episodes.record import EpisodeRecord, OpenEpisode
from detector.engine.episodes.statistics import Statistics
from detector.engine.episodes.subjects import Subject, fits
from detector.engine.scoping.plugins import PluginSignals
from detector.engine.scoping.scopes import Candidate, Evaluated, Views, candidates, condition
from detector.engine.scoping.snapshots import signals_read, snapshot
from detector.engine.timing.schedule import SubjectFilter
from wayside.api.base import JsonValue
from wayside.expressions import Expression, Unknown
from wayside.rules import CompiledRule


@dataclass(frozen=True, slots=True)
class OnDemandResult:
    """The result of a rule with `onDemand` for one subject."""

    subject: str
    when: bool | None
    """None: unknown."""
    values: Mapping[str, JsonValue]
    """Signals, as in an event; unknown ones are left out."""
    episode: EpisodeRecord | None
    """The open episode, after this evaluation."""


class RuleRun:
    """A rule and the states of its subjects."""

    def __init__(self, rule: CompiledRule, identity: DetectorIdentity, counters: RuleCounters) -> None:
        self.rule = rule
        self.read = {field: signals_read(rule, each) for field, each in (("when", rule.when), ("until", rule.until))}
        """By condition, the signals and streams that it reads, as a text for errors."""
        self.counters = counters
        self._identity = identity
        self.timing = Timing(rule.for_ns, rule.cooldown_ns, rule.unknown_timeout_ns)
        self._follows = any(deploy.follow for deploy in rule.deploys)
        self.earlier = EarlierValues()
        """Earlier values for signals over other signals."""
        self.on_evaluated: Callable[[Evaluated], None] | None = None
        """If set, called with each evaluation. It influences no result."""
        self.version = 0
        """Changes whenever the demands do."""
        self.states: dict[Subject, SubjectState] = {}
        """The states of the subjects that have one. The rule's group changes them too."""
        self._open: dict[Subject, EpisodeState] = {}
        self._muted: set[Subject] = set()
        """Subjects with an episode beyond the budget: the episode continues, without events."""
        self.budget = Budget()
        """The starts of the last hour."""
        self._answers: list[OnDemandResult] | None = None
        self.touched: list[Subject] = []
        """The subjects evaluated since the last evaluation with samples began: their states may have changed."""
        self.disturbed = True
        """Whether states changed outside the rule's group, so that every subject must be evaluated again."""
        self.journal: list[DemandChange] | None = None
        """Changes of demands, in time order; None: they are not recorded."""

    def tick(
        self, now: int, views: Views, clients: Clients, plugins: PluginSignals, only: SubjectFilter | None = None
    ) -> list[Event]:
        """Evaluate the rule for all subjects, or for `only` these; returns what started and ended, in order of
        subjects."""
        self.disturbed = True
        events = [] if only is not None else [*self._lost(now, clients)]
        self.touched = []
        seen = candidates(self.rule, views, clients, self._in_progress(), only)
        seen = plugins.added(self.rule, seen, self.counters, every_subject=only is None)
        if self.rule.derived:
            seen = with_derived(self.rule, self.earlier, now, seen, self.counters)
        for candidate in seen:
            self.counters.evaluations += 1
            self.touched.append(candidate.subject)
            events += self._subject(now, candidate)
        if only is None:
            self.tidy(now)
        return sorted(events, key=lambda event: event.episode.subject)

    def end_lost(self, now: int, clients: Clients) -> list[Event]:
        """For a rule without a period: end the episodes of lost clients, and forget states that have expired."""
        self.disturbed = True
        events = [*self._lost(now, clients)]
        self.tidy(now)
        return sorted(events, key=lambda event: event.episode.subject)

    def answer(
        self, now: int, views: Views, clients: Clients, plugins: PluginSignals
    ) -> tuple[list[Event], list[OnDemandResult]]:
        """Evaluate the rule for all subjects; returns the events, and the result for each subject in order."""
        self._answers = []
        events = self.tick(now, views, clients, plugins)
        answers, self._answers = self._answers, None
        return events, sorted(answers, key=lambda answer: answer.subject)

    def forget_pending(self) -> None:
        """The rule is paused: keep open episodes, discard pending ones."""
        self.disturbed = True
        for state in self.states.values():
            state.gap()

    @property
    def alone(self) -> bool:
        """Whether an observer needs each evaluation separately."""
        return self.on_evaluated is not None or self.counters.notes is not None

    def wakes(self, now: int, subjects: Iterable[Subject]) -> Iterator[tuple[Subject, int | None]]:
        """When each of the subjects must be evaluated again; nanoseconds after `now`, None: never."""
        for subject in subjects:
            state = self.states.get(subject)
            yield subject, None if state is None else state.wake(now, self.timing)

    def tidy(self, now: int) -> None:
        """Forget subjects whose state equals a new one, and starts that are over an hour old."""
        self.states = {subject: state for subject, state in self.states.items() if not state.idle_at(now)}
        self.budget.expire(now)

    @property
    def open_episodes(self) -> int:
        """Number of open episodes."""
        return len(self._open)

    @property
    def pending(self) -> int:
        """Subjects whose condition holds, but for less than `for`."""
        return sum(state.onset is not None for state in self.states.values())

    def gap(self, time: int) -> None:
        """Time jumped without ticks: keep open episodes, discard pending ones, reset windows."""
        self.disturbed = True
        self.earlier.clear()
        for state in self.states.values():
            state.gap()
            state.rests_until = min(state.rests_until, time + self.timing.cooldown)

    def can_restore(self, record: EpisodeRecord) -> bool:
        """Whether the episode belongs to this rule in its current version."""
        return (
            self.rule.enabled
            and self.rule.digest == record.rule_digest
            and fits(self.rule, record.about)
            and record.about not in self._open
        )

    def restore(self, episode: OpenEpisode, demands: Sequence[Demand]) -> Event:
        """Restore an episode that was open before a restart, with the demands of its actions.

        Returns its start event. If an action has changed, its demand stays valid until it is rendered again, at the
        next evaluation.
        """
        self.disturbed = True
        record, subject = episode.record, episode.record.about
        deploys = {deploy.action: deploy.fixed for deploy in self.rule.deploys}
        self.states[subject] = SubjectState(is_open=True)
        state = self._open[subject] = EpisodeState(
            msgspec.structs.replace(record, classification=self.rule.classification),
            None,
            {d.action: d for d in demands if d.action in deploys},
            {d.action for d in demands if d.action in deploys and deploys[d.action] != d.fixed},
            Statistics.of(self.rule, record.start_time),
        )
        if state.statistics is not None and episode.statistics is not None:
            state.statistics.restore(episode.statistics)
        return state.started(self.rule, self._identity)

    def episodes(self) -> Iterator[OpenEpisode]:
        """The episodes that have not ended."""
        return (episode.to_open_episode() for episode in self._open.values())

    def change_actions(self, rule: CompiledRule) -> None:
        """Switch to a rule with the same conditions but other actions.

        Demands of removed actions end at once; those of changed actions stay valid until they are rendered again.
        """
        changed = {deploy.action for deploy in {*rule.deploys} ^ {*self.rule.deploys}}
        gone = changed - {deploy.action for deploy in rule.deploys}
        self.disturbed = True
        self.rule = rule
        self.timing = Timing(rule.for_ns, rule.cooldown_ns, rule.unknown_timeout_ns)
        self._follows = any(deploy.follow for deploy in rule.deploys)
        for episode in self._open.values():
            episode.change(rule, changed, gone)
            self._render(episode)

    def end_all(self, now: int, reason: EndReason) -> Iterator[Event]:
        """End every open episode, in order of the subjects, and discard pending ones."""
        self.disturbed = True
        for subject in sorted(self._open, key=lambda each: each.text):
            yield self._cut_off(now, self._open.pop(subject), reason)
        self.states.clear()
        self._muted.clear()

    def demands(self) -> Iterator[Demand]:
        """The demands of the open episodes."""
        if not self.rule.dry_run:
            for episode in self._open.values():
                yield from episode.demands.values()

    def open_starts(self) -> Iterator[Event]:
        """The start events of the open episodes, in order of the subjects."""
        for subject in sorted(self._open, key=lambda each: each.text):
            yield self._open[subject].started(self.rule, self._identity)

    def _in_progress(self) -> Iterator[Subject]:
        return (subject for subject, state in self.states.items() if state.is_open or state.onset is not None)

    def _lost(self, now: int, clients: Clients) -> Iterator[Event]:
        for subject in [s for s in self.states if any(client not in clients for client in s.clients)]:
            state = self.states[subject]
            if state.is_open:
                state.end(now, self.timing)
                if subject in self._muted:
                    self._muted.discard(subject)
                else:
                    yield self._cut_off(now, self._open.pop(subject), EndReason.CLIENT_LOST)
            else:
                state.gap()

    def _cut_off(self, now: int, episode: EpisodeState, reason: EndReason) -> Event:
        """End an episode without an evaluation: only the statistics of the episode are known."""
        known = {} if episode.statistics is None else episode.statistics.values(now)
        return self._ended(now, episode, reason, known, known)

    @property
    def measured(self) -> Mapping[Subject, Statistics]:
        """The statistics of the open episodes; empty if the rule has no signals over episodes."""
        return {subject: each.statistics for subject, each in self._open.items() if each.statistics is not None}

    def statistics(self, subject: Subject) -> Statistics | None:
        """The statistics of the subject's open episode, if it has one."""
        episode = self._open.get(subject)
        return None if episode is None else episode.statistics

    def _measured(self, now: int, statistics: Statistics | None, candidate: Candidate) -> Candidate:
        """The candidate, with the statistics of its episode up to this evaluation."""
        if statistics is None:
            return candidate
        found = statistics.up_to(now, candidate.measured, self.counters)
        return candidate._replace(variables={**candidate.variables, **found})

    def _subject(self, now: int, candidate: Candidate) -> Iterator[Event]:
        state = self.state(candidate.subject)
        when = self._truth("when", self.rule.when, candidate)
        until = negation(when) if self.rule.until is None else self._truth("until", self.rule.until, candidate)
        happened = state.step(now, self.timing, Observation(candidate.in_scope, candidate.near, when, until))
        if happened is None:
            self.stays(now, candidate)
        elif (event := self.happened(now, happened, candidate)) is not None:
            yield event
        if self.on_evaluated is not None:
            self.on_evaluated(Evaluated(now, candidate, when, until, state.is_open, state.onset))
        if self._answers is not None:
            self._answers.append(self._answer(candidate, when))

    def state(self, subject: Subject) -> SubjectState:
        """The subject's state; a new one if it had none."""
        state = self.states.get(subject)
        if state is None:
            state = self.states[subject] = SubjectState()
        return state

    def needs_every_tick(self, subject: Subject) -> bool:
        """Whether the subject needs an evaluation although its observation is the same, because its demands may
        change."""
        episode = self._open.get(subject)
        return episode is not None and (self._follows or not episode.is_complete(self.rule))

    def happened(self, now: int, what: Started | Ended, candidate: Candidate) -> Event | None:
        """An episode of the subject started or ended; returns its event, None if it has none."""
        subject = candidate.subject
        if isinstance(what, Ended):
            if subject in self._muted:
                self._muted.discard(subject)
                return None
            ended = self._open.pop(subject)
            candidate = self._measured(now, ended.statistics, candidate)
            return self._ended(now, ended, what.reason, snapshot(self.rule, candidate), candidate.variables)
        limit = self.rule.maximum_per_hour
        if limit is None or self.budget.try_acquire(subject.clients, now, limit):
            return self._started(now, what.onset, candidate)
        self.counters.suppressed += 1
        self._muted.add(subject)
        return None

    def stays(self, now: int, candidate: Candidate) -> None:
        """Nothing started or ended, but parameters with `follow` of an open episode may have changed."""
        episode = self._open.get(candidate.subject)
        if episode is None:
            return
        candidate = self._measured(now, episode.statistics, candidate)
        before = dict(episode.demands) if self.journal is not None else {}
        if not episode.is_complete(self.rule):
            episode.variables = candidate.variables
            self._render(episode)
        self.version += episode.follow(self.rule, candidate.variables, self.counters)
        self._note_demands(now, episode, before)

    def _note_demands(
        self, now: int, episode: EpisodeState, before: Mapping[str, Demand], end: int | None = None
    ) -> None:
        """Note which demands differ from `before`; if they end, all of them."""
        if self.journal is None or self.rule.dry_run:
            return
        for action, demand in episode.demands.items():
            if end is not None or demand != before.get(action):
                self.journal.append(DemandChange(now, demand, end))

    def _answer(self, candidate: Candidate, when: Truth) -> OnDemandResult:
        episode = self._open.get(candidate.subject)
        return OnDemandResult(
            candidate.subject.text,
            None if isinstance(when, Unknown) else when,
            snapshot(self.rule, candidate),
            None if episode is None else episode.record,
        )

    def _truth(self, field: str, expression: Expression, candidate: Candidate) -> Truth:
        place = f"{field} of {candidate.subject.text}{self.read[field]}"
        return condition(expression, candidate.variables, place, candidate.never, self.counters)

    def _started(self, now: int, onset: int, candidate: Candidate) -> Event:
        subject, rule = candidate.subject, self.rule
        statistics = None
        if rule.derived:
            statistics = Statistics.of(rule, now)
            candidate = self._measured(now, statistics, candidate)
        record = new_record(rule, self._identity, subject, onset, now, snapshot(rule, candidate))
        episode = EpisodeState(record, candidate.variables if rule.has_actions else None, statistics=statistics)
        self._open[subject] = episode
        self.counters.started += 1
        if rule.deploys:
            self._render(episode)
            self._note_demands(now, episode, {})
        return episode.started(rule, self._identity)

    def _ended(
        self,
        now: int,
        episode: EpisodeState,
        reason: EndReason,
        values: Mapping[str, Any],
        variables: Mapping[str, Any],
    ) -> Event:
        self.counters.ended += 1
        self.version += 1
        self._note_demands(now, episode, {}, now)
        return episode.ended(self.rule, self._identity, now, reason, values, variables)

    def _render(self, episode: EpisodeState) -> None:
        self.version += episode.render(self.rule, self._identity, self.counters)


def same_semantics(run: RuleRun, rule: CompiledRule) -> bool:
    """Whether open episodes continue under the new rule."""
    return run.rule.digest == rule.digest and run.rule.enabled == rule.enabled
