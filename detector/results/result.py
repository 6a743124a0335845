"""The result of one recording, the input of all outputs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

from detector.engine.episodes.events import Event
from detector.replay.replaying import ReplayResult
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
    """By rule and subject, the terms that its conditions compare."""
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


def result_of(name: str, outcome: ReplayResult, tracer: Tracer, arrivals: Arrivals) -> Result:
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


class Polygon(NamedTuple):
    """An area or a line."""

    rule: str
    name: str
    """The name of the place or parameter, or of the element and the field."""
    corners: tuple[tuple[float, float], ...]
    """x and y in metres, or latitude and longitude in degrees."""
    geographic: bool
    closed: bool = True
    """Whether it is an area; otherwise it is a line."""


def polygons_of(rules: Iterable[CompiledRule]) -> Iterator[Polygon]:
    """The places that rules name, each once, and the areas among their parameters and elements."""
    named_already: set[str] = set()
    for rule in rules:
        for place in rule.places:
            if place.key not in named_already:
                named_already.add(place.key)
                for ring in place.rings:
                    yield Polygon(rule.name, place.name, ring, place.geographic)
                if place.line:
                    yield Polygon(rule.name, place.name, place.line, place.geographic, closed=False)
        named: dict[str, Any] = dict(rule.parameters.own)
        for element in rule.elements:
            for variable in element.variables.values():
                if isinstance(variable, Mapping):
                    named |= {f"{element.name} {key}": value for key, value in variable.items()}
        read = rule.when.source + (rule.until.source if rule.until is not None else "")
        read += "".join(signal.value.source for signal in rule.signals if signal.value is not None)
        for name, value in named.items():
            corners = _corners(value)
            if corners is not None:
                yield Polygon(rule.name, name, corners, "insideWgs84" in read)


def _corners(value: Any) -> tuple[tuple[float, float], ...] | None:
    if not isinstance(value, list) or len(value) < 3:
        return None
    found = []
    for each in value:
        pair = [each.get("x"), each.get("y")] if isinstance(each, Mapping) else each
        if not isinstance(pair, list) or len(pair) != 2 or not all(isinstance(axis, int | float) for axis in pair):
            return None
        found.append((float(pair[0]), float(pair[1])))
    return tuple(found)
