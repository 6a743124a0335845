"""Recordings played one after another, each through an engine of its own: nothing goes from one into the next."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol

from detector.engine.samples.sample import Arrival
from detector.engine.scoping.plugins import PluginHost
from detector.replay.errors import RecordingError
from detector.replay.gathering import Recording
from detector.replay.latched import recorded_arrivals
from detector.replay.message import Cut
from detector.replay.recorded_types import with_recorded_types
from detector.replay.replaying import Outcome, replay_arrivals
from detector.replay.routing import Router
from wayside.api import Detector, EventRule

Plugins = Callable[[], AbstractContextManager[PluginHost | None]]
"""Runs the plugins of one recording."""


class Watch(Protocol):
    """Sees what is replayed on its way."""

    def __call__(self, arrivals: Iterator[Arrival], /) -> Iterator[Arrival]:
        """The same arrivals."""


def play(
    recordings: Sequence[Recording],
    detector: Detector,
    rules: Sequence[EventRule],
    plugins: Plugins = nullcontext,
    watch: Watch = lambda arrivals: arrivals,
) -> list[Outcome]:
    """What each recording came to. Without `plugins` they run in this process.

    Raises:
        DetectorError: the Detector cannot run.
        RecordingError: a recording is damaged or does not fit the streams, or no message of any belongs to a stream.
    """
    outcomes: list[Outcome] = []
    keys: set[str] = set()
    for recording in recordings:
        cuts: list[Cut] = []
        completed = with_recorded_types(detector, recording)
        router = Router(completed.spec.streams)
        arrivals = recorded_arrivals(recording, router, completed, cuts.append)
        with plugins() as host:
            outcome = replay_arrivals(watch(arrivals), completed, rules, host)
        outcome.doubts[:0] = map(str, cuts)
        if not outcome.samples:
            outcome.notes.append(f"no message belongs to a stream of the Detector; keys: {_listed(router.unrouted)}")
        keys.update(router.unrouted)
        outcomes.append(outcome)
    if not any(outcome.samples for outcome in outcomes):
        cut = "".join(f"{doubt}; " for outcome in outcomes for doubt in outcome.doubts)
        asked = _listed([stream.key for stream in detector.spec.streams])
        raise RecordingError(
            f"{cut}no message belongs to a stream of the Detector: the recordings hold the keys "
            f"{_listed(sorted(keys))}, the streams ask for {asked}: correct the streams' key"
        )
    return outcomes


def name_of(recording: Recording) -> str:
    """For people."""
    return str(recording[0]) if len(recording) == 1 else f"{recording[0]} and {len(recording) - 1} more"


def _listed(keys: Sequence[str]) -> str:
    return ", ".join(keys[:20]) or "none"
