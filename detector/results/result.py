"""The result of one recording, the input of all outputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from detector.engine.episodes.events import Event
from detector.replay.replaying import Replayed
from detector.results.episodes import EpisodeRow, episodes_of
from detector.results.nearest import NearMoment, nearest_moments
from detector.results.quality import Arrivals, StreamQuality
from detector.results.series import Trace
from detector.results.thresholds import Terms, terms_of
from detector.results.tracing import Tracer
from wayside.api import ApplicationTask, EventRule
from wayside.rules import CompiledRule


@dataclass(frozen=True)
class Result:
    """The result of one recording."""

    recording: str
    """Its name."""
    trace: Trace
    events: Sequence[Event]
    tasks: Sequence[ApplicationTask]
    rules: Mapping[str, CompiledRule]
    """The rules that were evaluated at the end, by name."""
    documents: Mapping[str, EventRule]
    """The rules as written."""
    terms: Mapping[tuple[str, str], Terms]
    """By rule and subject, what its conditions compare."""
    streams: Sequence[StreamQuality]
    counts: Mapping[str, tuple[int, int, int]]
    """By rule: evaluations, unknown values, errors."""
    notes: Sequence[str]
    """Notes about the recording for users."""
    samples: int

    @cached_property
    def episodes(self) -> list[EpisodeRow]:
        """The episodes, in order of their starts."""
        return episodes_of(self.recording, self.events, self.trace)

    @cached_property
    def nearest(self) -> list[NearMoment]:
        """The moments at which rules with a margin came nearest to an episode without one."""
        return nearest_moments(self.recording, self.rules, self.trace.subjects, self.episodes)


def result_of(name: str, outcome: Replayed, tracer: Tracer, arrivals: Arrivals) -> Result:
    """The result of a replay; `tracer` and `arrivals` observed it.

    Raises:
        ValueError: the tracer observed no engine.
    """
    engine = tracer.engine
    if engine is None:
        raise ValueError(f"{name} was not read")
    trace = tracer.trace()
    rules = {rule: run.rule for rule, run in engine.rules.items()}
    terms = {
        (each.rule, each.subject): terms_of(rules[each.rule], each) for each in trace.subjects if each.rule in rules
    }
    counted = engine.counters.rules
    return Result(
        recording=name,
        trace=trace,
        events=outcome.events,
        tasks=[*outcome.tasks.values()],
        rules=rules,
        documents=outcome.rules,
        terms=terms,
        streams=arrivals.by_stream(engine.detector, engine.counters),
        counts={rule: (each.evaluations, each.unknowns, each.errors) for rule, each in counted.items()},
        notes=[*map(str, (*outcome.cuts, *outcome.doubts)), *outcome.notes],
        samples=outcome.samples,
    )
