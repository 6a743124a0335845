"""Makes the samples of latched streams available from the beginning of a recording, wherever they were recorded.

A recording that began after a map or a static transform was published contains it late, or at an unexpected place. So
the first sample of each topic on a latched stream comes first, and is not repeated at its original place.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

from msgspec.structs import replace

from detector.assembly import inlets
from detector.engine.buffering.lanes import latched_topics
from detector.engine.buffering.latched import Topic
from detector.engine.samples.sample import Arrival
from detector.replay.message import OnCut, ignore
from detector.replay.recordings import open_recordings
from detector.replay.routing import MessageRouter
from wayside.api import Detector


def recorded_arrivals(
    recordings: Sequence[Path], router: MessageRouter, detector: Detector, on_cut: OnCut = ignore
) -> Iterator[list[Arrival]]:
    """The recordings' messages for the Detector's streams, in lists; those of latched streams first.

    Raises:
        DetectorError: the Detector cannot run.
        RecordingError: a recording is missing or damaged, or does not fit the streams.
    """
    arrivals = router.arrivals(open_recordings(recordings, router.wanted, on_cut))
    topics = latched_topics(detector, inlets(detector).decoders)
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
            first.setdefault(_about(arrival, topics), arrival)
    taken: set[tuple[str, Hashable]] = set()

    def is_taken(arrival: Arrival) -> bool:
        """Whether the arrival, of a latched stream, was moved to the beginning."""
        about = _about(arrival, topics)
        if about in taken:
            return False
        taken.add(about)
        return True

    for number, arrivals in enumerate(recorded):
        if not number and first:
            yield [replace(arrival, received=arrivals[0].received) for arrival in first.values()]
        if rest := [each for each in arrivals if each.stream not in topics or not is_taken(each)]:
            yield rest


def _about(arrival: Arrival, topics: dict[str, Topic]) -> tuple[str, Hashable]:
    return arrival.stream, topics[arrival.stream](arrival.key, arrival.payload)
