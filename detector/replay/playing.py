"""Plays recordings one after another, each through a separate engine: no state passes from one to the next."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import NamedTuple, Protocol

import msgspec

from detector.engine.samples.sample import Arrival
from detector.engine.scoping.plugins import PluginHost
from detector.replay.clips import Clips
from detector.replay.errors import RecordingError
from detector.replay.gathering import Recording, recording_name
from detector.replay.latched import recorded_arrivals
from detector.replay.message import Cut
from detector.replay.recorded_types import with_recorded_types
from detector.replay.replaying import Replayed, ReplayObserver, replay_arrivals
from detector.replay.routing import MessageRouter
from wayside.api import Detector, EventRule

Plugins = Callable[[], AbstractContextManager[PluginHost | None]]
"""Runs the plugins of one recording."""


class ReplayWatch(Protocol):
    """Observes the arrivals of a replay."""

    def __call__(self, batches: Iterable[Sequence[Arrival]], /) -> Iterable[Sequence[Arrival]]:
        """The same arrivals."""


class Played(NamedTuple):
    """The result of playing several recordings."""

    outcomes: dict[str, Replayed]
    """By the recording's name, in the order given; at least one."""
    errors: list[RecordingError]
    """Why the other recordings could not be replayed."""


def play(
    recordings: Sequence[Recording],
    detector: Detector,
    rules: Sequence[EventRule],
    plugins: Plugins = nullcontext,
    watch: ReplayWatch = lambda batches: batches,
    onlooker: Callable[[str], ReplayObserver | None] = lambda _: None,
    clips: Clips | None = None,
    holder: str | None = None,
) -> Played:
    """The outcome of each recording. Without `plugins` they run in this process. `holder` is by default the Detector.

    For several recordings, the events of each name it, and from the second on its number is part of the holder: ids and
    task names differ even if all begin at the same time. `onlooker` returns the onlooker for the recording of that
    name. With `clips`, the rules' record actions run.

    Raises:
        DetectorError: the Detector cannot run.
        RecordingError: the one recording is damaged or does not fit the streams, or no message of any belongs to a
            stream; an ExceptionGroup of these where several recordings have several errors.
    """
    outcomes: dict[str, Replayed] = {}
    errors: list[RecordingError] = []
    unrouted: dict[str, list[str]] = {}
    for number, recording in enumerate(recordings, start=1):
        name = recording_name(recording)
        try:
            of = (holder or detector.name) + (f".{number}" if number > 1 else "")
            outcome, unrouted[name] = _played(recording, detector, rules, plugins, watch, of, onlooker(name), clips)
        except RecordingError as error:
            errors.append(error)
            continue
        if len(recordings) > 1:
            outcome.events = [msgspec.structs.replace(event, recording=name) for event in outcome.events]
        outcomes[name] = outcome
    if not any(outcome.samples for outcome in outcomes.values()):
        errors += _without_samples(outcomes, unrouted, detector)
        raise errors[0] if len(errors) == 1 else ExceptionGroup("no recording can be replayed", errors)
    return Played(outcomes, errors)


def _played(
    recording: Recording,
    detector: Detector,
    rules: Sequence[EventRule],
    plugins: Plugins,
    watch: ReplayWatch,
    holder: str,
    onlooker: ReplayObserver | None,
    clips: Clips | None,
) -> tuple[Replayed, list[str]]:
    """The outcome of a recording, and its keys that belong to no stream."""
    cuts: list[Cut] = []
    completed = with_recorded_types(detector, recording)
    router = MessageRouter(completed.spec.streams, recording_name(recording))
    arrivals = recorded_arrivals(recording, router, completed, cuts.append)
    with plugins() as host:
        outcome = replay_arrivals(watch(arrivals), completed, rules, host, holder, onlooker, clips)
    outcome.cuts = cuts
    if not outcome.samples:
        keys = router.unrouted
        none = f"no message belongs to a stream of the Detector; keys: {_listed(keys)}"
        outcome.notes.append(none if keys else "it contains no message")
    return outcome, router.unrouted


def _without_samples(
    outcomes: dict[str, Replayed], unrouted: dict[str, list[str]], detector: Detector
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
