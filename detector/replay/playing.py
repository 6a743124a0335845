"""Plays recordings one after another, each through a separate engine: no state passes from one to the next.

A recording that began after a map or a static transform was published contains it late, or at an unexpected place. So
the first sample of each topic on a latched stream comes first, and is not repeated at its original place.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from itertools import chain
from pathlib import Path
from typing import NamedTuple, Protocol

import msgspec
from msgspec.structs import replace

from detector.assembly import stream_readers
from detector.engine.buffering.lanes import Topic, latched_topics
from detector.engine.samples.sample import Arrival
from detector.engine.scoping.plugins import PluginHost
from detector.replay.clips import Clips
from detector.replay.gathering import Recording, recording_name
from detector.replay.message import OnCut, RecordingError, Truncation, ignore
from detector.replay.recorded_types import with_recorded_types
from detector.replay.recordings import open_recordings
from detector.replay.replaying import ReplayObserver, ReplayResult, replay_arrivals
from detector.replay.routing import MessageRouter
from wayside.api import Detector, EventRule

Plugins = Callable[[], AbstractContextManager[PluginHost | None]]
"""Runs the plugins of one recording."""


class ReplayWatch(Protocol):
    """Observes the arrivals of a replay."""

    def __call__(self, batches: Iterable[Sequence[Arrival]], /) -> Iterable[Sequence[Arrival]]:
        """The same arrivals."""


class PlayResult(NamedTuple):
    """The result of playing several recordings."""

    outcomes: dict[str, ReplayResult]
    """By the recording's name, in the order given; at least one."""
    errors: list[RecordingError]
    """Why the other recordings could not be replayed."""


def play(
    recordings: Sequence[Recording],
    detector: Detector,
    rules: Sequence[EventRule],
    plugins: Plugins = nullcontext,
    watch: ReplayWatch = lambda batches: batches,
    observer: Callable[[str], ReplayObserver | None] = lambda _: None,
    clips: Clips | None = None,
    holder: str | None = None,
) -> PlayResult:
    """The outcome of each recording. Without `plugins` they run in this process. `holder` is by default the Detector.

    For several recordings, the events of each name it, and from the second on its number is part of the holder: ids and
    task names differ even if all begin at the same time. `observer` returns the observer for the recording of that
    name. With `clips`, the rules' record actions run.

    Raises:
        DetectorError: the Detector cannot run.
        RecordingError: the one recording is damaged or does not fit the streams, or no message of any belongs to a
            stream; an ExceptionGroup of these where several recordings have several errors.
    """
    outcomes: dict[str, ReplayResult] = {}
    errors: list[RecordingError] = []
    unrouted: dict[str, list[str]] = {}
    for number, recording in enumerate(recordings, start=1):
        name = recording_name(recording)
        try:
            of = (holder or detector.name) + (f".{number}" if number > 1 else "")
            outcome, unrouted[name] = _played(recording, detector, rules, plugins, watch, of, observer(name), clips)
        except RecordingError as error:
            errors.append(error)
            continue
        if len(recordings) > 1:
            outcome.events = [msgspec.structs.replace(event, recording=name) for event in outcome.events]
        outcomes[name] = outcome
    if not any(outcome.samples for outcome in outcomes.values()):
        errors += _without_samples(outcomes, unrouted, detector)
        raise errors[0] if len(errors) == 1 else ExceptionGroup("no recording can be replayed", errors)
    return PlayResult(outcomes, errors)


def _played(
    recording: Recording,
    detector: Detector,
    rules: Sequence[EventRule],
    plugins: Plugins,
    watch: ReplayWatch,
    holder: str,
    observer: ReplayObserver | None,
    clips: Clips | None,
) -> tuple[ReplayResult, list[str]]:
    """The outcome of a recording, and its keys that belong to no stream."""
    cuts: list[Truncation] = []
    completed = with_recorded_types(detector, recording)
    router = MessageRouter(completed.spec.streams, recording_name(recording))
    arrivals = recorded_arrivals(recording, router, completed, cuts.append)
    with plugins() as host:
        outcome = replay_arrivals(watch(arrivals), completed, rules, host, holder, observer, clips)
    outcome.cuts = cuts
    if not outcome.samples:
        keys = router.unrouted
        none = f"no message belongs to a stream of the Detector; keys: {_listed(keys)}"
        outcome.notes.append(none if keys else "it contains no message")
    return outcome, router.unrouted


def _without_samples(
    outcomes: dict[str, ReplayResult], unrouted: dict[str, list[str]], detector: Detector
) -> Iterator[RecordingError]:
    """Why none of the recordings has anything to evaluate."""
    for name, outcome in outcomes.items():
        if not unrouted[name]:
            cut = "".join(f": it is cut ({each.reason})" for each in outcome.cuts[:1])
            yield RecordingError(f"{name} contains no message{cut}")
    if keys := sorted({key for found in unrouted.values() for key in found}):
        cut = "".join(f"{each}; " for name, outcome in outcomes.items() if unrouted[name] for each in outcome.cuts)
        expected = _listed([stream.key for stream in detector.spec.streams])
        yield RecordingError(
            f"{cut}no message belongs to a stream of the Detector: the recordings have the keys {_listed(keys)}, "
            f"the streams request {expected}: correct the key of the streams"
        )


def _listed(keys: Sequence[str]) -> str:
    return ", ".join(keys[:20]) or "none"


def recorded_arrivals(
    recordings: Sequence[Path], router: MessageRouter, detector: Detector, on_cut: OnCut = ignore
) -> Iterator[list[Arrival]]:
    """The recordings' messages for the Detector's streams, in lists; those of latched streams first.

    Raises:
        DetectorError: the Detector cannot run.
        RecordingError: a recording is missing or damaged, or does not fit the streams.
    """
    arrivals = router.arrivals(open_recordings(recordings, router.wanted, on_cut))
    topics = latched_topics(detector, stream_readers(detector).decoders)
    if not topics:
        return arrivals
    # Read once for these only (a recording with an index skips the rest): it need not fit into memory as a whole.
    latched = MessageRouter([stream for stream in detector.spec.streams if stream.latched])
    latched_arrivals = chain.from_iterable(latched.arrivals(open_recordings(recordings, latched.wanted)))
    return latched_first(arrivals, latched_arrivals, topics)


def latched_first(
    recorded: Iterable[list[Arrival]], latched: Iterable[Arrival], topics: dict[str, Topic]
) -> Iterator[list[Arrival]]:
    """The arrivals of a recording. Latched ones come first, at the time of the recording's first sample.

    Args:
        recorded: all arrivals in order, in lists that are not empty.
        latched: the same, or only those of latched streams, in order.
        topics: for each latched stream, the function that returns the topic of a sample.
    """
    first: dict[tuple[str, Hashable], Arrival] = {}
    for arrival in latched:
        if arrival.stream in topics:
            first.setdefault(_topic_of(arrival, topics), arrival)
    taken: set[tuple[str, Hashable]] = set()

    def is_moved(arrival: Arrival) -> bool:
        """Whether the arrival, of a latched stream, was moved to the beginning."""
        topic = _topic_of(arrival, topics)
        if topic in taken:
            return False
        taken.add(topic)
        return True

    for number, arrivals in enumerate(recorded):
        if not number and first:
            yield [replace(arrival, received=arrivals[0].received) for arrival in first.values()]
        if rest := [each for each in arrivals if each.stream not in topics or not is_moved(each)]:
            yield rest


def _topic_of(arrival: Arrival, topics: dict[str, Topic]) -> tuple[str, Hashable]:
    return arrival.stream, topics[arrival.stream](arrival.key, arrival.payload)
