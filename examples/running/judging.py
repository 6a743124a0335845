"""Compares the actual results of a scenario with the expected ones."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from detector.engine.episodes.events import Event
from examples.running.demanding import running_at, unlike
from examples.running.playing import Played, seconds
from examples.running.scenario import Episode, Scenario

_EARLY_S = 1e-6


@dataclass(slots=True)
class Verdict:
    """The expected and actual numbers, and each difference as a line."""

    expected: int = 0
    """Events: starts and ends."""
    found: int = 0
    actions_expected: int = 0
    actions_done: int = 0
    problems: list[str] = field(default_factory=list)

    @property
    def as_it_must_be(self) -> bool:
        """Whether nothing differs."""
        return not self.problems


def judge(scenario: Scenario, played: Played, folder: Path) -> Verdict:
    """Compare events, actions, what would run, and whatever else the scenario knows; `folder` is the use case's."""
    verdict = Verdict(
        expected=sum(1 if each.end_s is None else 2 for each in scenario.episodes),
        found=len(played.events),
        actions_expected=sum(scenario.actions.values()),
        actions_done=played.done().total(),
    )
    verdict.problems += _episodes(scenario.episodes, played.events)
    verdict.problems += _actions(scenario, played)
    verdict.problems += played.failures()
    for moment in scenario.moments:
        verdict.problems += unlike(moment, running_at(folder, played.history, moment.at_s))
    verdict.problems += scenario.check(played)
    return verdict


def _episodes(expected: Iterable[Episode], events: Iterable[Event]) -> Iterator[str]:
    wanted: dict[tuple[str, str], list[Episode]] = defaultdict(list)
    for each in sorted(expected, key=lambda each: each.start_s):
        wanted[each.rule, each.subject].append(each)
    found: dict[tuple[str, str], list[list[Event]]] = defaultdict(list)
    for event in events:
        if event.started:
            found[event.episode.rule, event.episode.subject].append([event])
        else:
            found[event.episode.rule, event.episode.subject][-1].append(event)
    for rule, subject in sorted({*wanted, *found}):
        must, there = wanted[rule, subject], found[rule, subject]
        if len(must) != len(there):
            starts = ", ".join(f"{seconds(each[0].episode.start_time):g} s" for each in there) or "never"
            due = ", ".join(f"{each.start_s:g} s" for each in must) or "never"
            yield f"{rule} of {subject} starts {starts}; expected: {due}"
            continue
        for episode, those in zip(must, there, strict=True):
            yield from _episode(episode, those)


def _episode(episode: Episode, events: list[Event]) -> Iterator[str]:
    who = f"{episode.rule} of {episode.subject}"
    start = seconds(events[0].episode.start_time)
    if not episode.start_s - _EARLY_S <= start <= episode.start_s + episode.within_s + _EARLY_S:
        yield f"{who} starts at {start:g} s; expected: {episode.start_s:g} s, and {episode.within_s:g} s later at most"
    if episode.end_s is None:
        if len(events) > 1:
            yield f"{who}, from {start:g} s on, ends ({events[1].reason}); expected: it is open at the end"
        return
    if len(events) == 1:
        yield f"{who}, from {start:g} s on, does not end; expected: at {episode.end_s:g} s"
        return
    end = seconds(events[1].end_time or 0)
    if not episode.end_s - _EARLY_S <= end <= episode.end_s + episode.within_s + _EARLY_S:
        yield f"{who} ends at {end:g} s; expected: {episode.end_s:g} s, and {episode.within_s:g} s later at most"
    if events[1].reason != episode.reason:
        yield f"{who} ends at {end:g} s with reason {events[1].reason}; expected: {episode.reason}"


def _actions(scenario: Scenario, played: Played) -> Iterator[str]:
    done = played.done()
    for action in sorted({*scenario.actions, *done}):
        if scenario.actions.get(action, 0) != done[action]:
            yield f"{action} was done {done[action]} times; expected: {scenario.actions.get(action, 0)}"
