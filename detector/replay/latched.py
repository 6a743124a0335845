"""What latched streams say is known from the beginning of a recording, wherever in it it was recorded.

A recording that began after a map or a static transform was published holds it late, or not where its readers start. So
the first sample about each thing on a latched stream is taken first, and not again at its own place.
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
from detector.replay.routing import Router
from wayside.api import Detector


def recorded_arrivals(
    recordings: Sequence[Path], router: Router, detector: Detector, on_cut: OnCut = ignore
) -> Iterator[list[Arrival]]:
    """What the recordings hold for the Detector's streams, in lists; that of latched streams first.

    Raises:
        DetectorError: the Detector cannot run.
        RecordingError: a recording is missing or damaged, or does not fit the streams.
    """
    arrivals = router.arrivals(open_recordings(recordings, router.wanted, on_cut))
    topics = latched_topics(detector, inlets(detector).decoders)
    if not topics:
        return arrivals
    # Read once for these alone (a recording with an index skips the rest): the whole of it need not fit into memory.
    latched = Router([stream for stream in detector.spec.streams if stream.latched])
    latched_arrivals = chain.from_iterable(latched.arrivals(open_recordings(recordings, latched.wanted)))
    return latched_first(arrivals, latched_arrivals, topics)


def latched_first(
    recorded: Iterable[list[Arrival]], latched: Iterable[Arrival], topics: dict[str, Topic]
) -> Iterator[list[Arrival]]:
    """The arrivals of a recording. What was latched comes first, at the time of the recording's first sample.

    Args:
        recorded: all arrivals in order, in lists that are not empty.
        latched: the same, or those of latched streams alone, in order.
        topics: for each latched stream, what a sample speaks of.
    """
    first: dict[tuple[str, Hashable], Arrival] = {}
    for arrival in latched:
        if arrival.stream in topics:
            first.setdefault(_about(arrival, topics), arrival)
    taken: set[tuple[str, Hashable]] = set()

    def is_taken(arrival: Arrival) -> bool:
        """Whether the arrival, of a latched stream, came first already."""
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
