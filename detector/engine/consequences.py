"""The messages that the actions of rules receive, in order: an episode begins, its samples, its end, completion.

The engine only queues these messages. The caller drains them and passes them to the actions, which may be slow.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from typing import NamedTuple

import msgspec

from detector.engine.buffering.buffer import Buffer, Lane
from detector.engine.episodes.episodes import EndReason
from detector.engine.episodes.events import Event
from detector.engine.episodes.rendering import Rendered
from detector.engine.samples.sample import Item, Sample
from wayside.rules import CompiledAction, CompiledRule, CompiledWindow


class EpisodeSample(NamedTuple):
    """One message of an episode's window, as it was received."""

    client: str
    stream: str
    key: str
    """The full key of the message, without a leading slash."""
    time: int
    """The message's time on the detector's time axis, in nanoseconds since the epoch."""
    received: int
    """Nanoseconds since the epoch; the stamp as well with clock Data."""
    payload: bytes
    """The payload as received, undecoded; for a stream with `items` the whole message, once for all its clients."""


_TIME = attrgetter("time")
_CLIENT = attrgetter("client")


@dataclass(slots=True, eq=False)
class Excerpt:
    """The samples of one window. Times are nanoseconds."""

    window: CompiledWindow
    clients: frozenset[str] | None
    """None: all."""
    begin: int
    """Samples after this time belong to it; of latched streams, also the last sample before."""
    until: int | None = None
    """Samples up to this time belong to it; None while the episode is open."""
    waiting: list[tuple[Lane, Sample]] = field(default_factory=list)
    """Samples that are later than the engine's time, or not drained yet."""
    lanes: list[Lane] = field(default_factory=list)
    """The lanes of the excerpt's samples."""

    def matches(self, lane: Lane) -> bool:
        """Whether the lane belongs to the window's streams and clients."""
        if lane.stream in self.window.shared:
            return True
        if lane.stream not in self.window.streams and lane.stream not in self.window.latched:
            return False
        return self.clients is None or lane.client in self.clients

    def drain(self, now: int) -> list[EpisodeSample]:
        """Remove and return the samples up to `now`, in time order; samples outside of the window are discarded."""
        reached = now if self.until is None else min(now, self.until)
        taken: list[EpisodeSample] = []
        listed: dict[tuple[str, int], EpisodeSample] = {}
        """Messages with items that belong to the window, by stream and number: each is one sample, attributed to the
        first client."""
        waiting: list[tuple[Lane, Sample]] = []
        for lane, sample in self.waiting:
            time = sample.time
            if time > reached:
                if self.until is None or time <= self.until:
                    waiting.append((lane, sample))
            elif time > self.begin or lane.latched:
                found = EpisodeSample(lane.client, lane.stream, sample.key, time, sample.received, sample.payload)
                if isinstance(sample, Item):
                    message = (lane.stream, sample.number)
                    listed[message] = min(found, listed.get(message, found), key=_CLIENT)
                else:
                    taken.append(found)
        self.waiting = waiting
        taken += listed.values()
        taken.sort(key=_TIME)
        return taken


class Excerpts:
    """All open excerpts of a buffer."""

    def __init__(self, buffer: Buffer) -> None:
        self._buffer = buffer
        self._watchers: dict[Lane, list[Excerpt]] = {}
        self._excerpts: list[Excerpt] = []
        buffer.on_added = self._added

    def begin(self, window: CompiledWindow, clients: frozenset[str] | None, begin: int) -> Excerpt:
        """Begin an excerpt: it contains the samples in the buffer, and those that arrive from now on."""
        self.distribute()
        excerpt = Excerpt(window, clients, begin)
        self._excerpts.append(excerpt)
        # There may be many clients, and an episode is about one or two of them.
        every = clients is None or window.shared
        for lane in self._buffer if every else self._buffer.of(sorted(clients or ())):
            if excerpt.matches(lane):
                self._watch(lane, excerpt)
                excerpt.waiting.extend((lane, sample) for sample in lane.samples)
        return excerpt

    def stop(self, excerpt: Excerpt) -> None:
        """No more samples follow for this excerpt."""
        self._excerpts.remove(excerpt)
        for lane in excerpt.lanes:
            self._watchers[lane].remove(excerpt)
            if not self._watchers[lane]:
                del self._watchers[lane]
                lane.record(None)

    def _added(self, lane: Lane) -> None:
        """Add a lane that is new in the buffer."""
        for excerpt in self._excerpts:
            if excerpt.matches(lane):
                self._watch(lane, excerpt)

    def _watch(self, lane: Lane, excerpt: Excerpt) -> None:
        watchers = self._watchers.setdefault(lane, [])
        if not watchers:
            lane.record([])
        watchers.append(excerpt)
        excerpt.lanes.append(lane)

    def distribute(self) -> None:
        """Add the samples that arrived since the last call to their excerpts."""
        for lane, inserted in self._inserted():
            for excerpt in self._watchers[lane]:
                excerpt.waiting.extend((lane, sample) for sample in inserted)

    def _inserted(self) -> Iterator[tuple[Lane, list[Sample]]]:
        """The samples inserted into the lanes since the last call."""
        for lane in self._watchers:
            inserted = lane.inserted
            if inserted:
                lane.record([])
                yield lane, inserted


_WATCHED = 100
_WATCHED_FOR = 10 * 10**9
"""Complete excerpts are watched for late samples: at most this number, for this time in nanoseconds."""

REPLACED = "the action was changed or removed"


class ActionRun(NamedTuple):
    """A run of one action, for one episode."""

    rule: str
    action: str
    episode: str


@dataclass(frozen=True, slots=True)
class RunStarted:
    """The action begins with an episode."""

    run: ActionRun
    event: Event
    """The start event."""
    rendered: Rendered
    resumed: bool
    """The episode was open before the detector started, or before the rule had this action."""


@dataclass(frozen=True, slots=True)
class RunSamples:
    """The next samples of the window."""

    run: ActionRun
    samples: list[EpisodeSample]


@dataclass(frozen=True, slots=True)
class EpisodeEnded:
    """The episode ended."""

    run: ActionRun
    event: Event
    """The end event."""


@dataclass(frozen=True, slots=True)
class RunCompleted:
    """No more messages of the run follow."""

    run: ActionRun
    cut: str = ""
    """Why the window ended early; empty if it did not."""


Consequence = RunStarted | RunSamples | EpisodeEnded | RunCompleted


class Consequences:
    """The runs of all actions except deploy."""

    def __init__(self, buffer: Buffer) -> None:
        self.wanted = False
        """Whether the caller drains the messages; otherwise none are queued, as in a replay without actions."""
        self._excerpts = Excerpts(buffer)
        self._running: dict[ActionRun, Excerpt | None] = {}
        """With the excerpt, if the action has a window."""
        self._requested: dict[ActionRun, Event] = {}
        """The runs that were requested from outside, with the event that began each."""
        self._noted: list[Consequence] = []
        self._complete_ones: deque[Excerpt] = deque()
        """Excerpts that are complete and still watched for late samples."""
        self.watch_late = False
        """Whether samples may come late, as with clock Data."""
        self.too_late = 0
        """Number of samples that arrived after their window was complete."""

    def note(self, rule: CompiledRule, event: Event) -> None:
        """Queue the start or end of an episode, before or after a change of its rule."""
        if event.started:
            self.begin(rule.actions, rule, event, resumed=False)
            return
        ended = (event.episode.rule, event.episode.id)
        for run in [run for run in self._running if (run.rule, run.episode) == ended]:
            self._end(run, event)

    def begin(self, actions: Iterable[CompiledAction], rule: CompiledRule, event: Event, *, resumed: bool) -> None:
        """These actions of the rule receive the episode from now on."""
        if rule.dry_run or not self.wanted:
            return
        for action in actions:
            run = ActionRun(rule.name, action.name, event.episode.id)
            window = action.window
            excerpt = None
            self._noted.append(RunStarted(run, event, event.rendered.get(action.name, Rendered()), resumed))
            if window is not None:
                clients = None if window.clients is None else window.clients | frozenset(event.episode.clients)
                excerpt = self._excerpts.begin(window, clients, event.episode.onset_time - window.before_ns)
            self._running[run] = excerpt

    def request(
        self,
        run: ActionRun,
        event: Event,
        window: CompiledWindow,
        clients: frozenset[str] | None,
        begin: int,
        until: int,
    ) -> None:
        """Begin a run that was requested from outside and belongs to no rule's episode. Times are nanoseconds.

        `event` describes it; `clients` None: all. It ends at `until` at the latest.
        """
        self._noted.append(RunStarted(run, event, Rendered(), resumed=False))
        excerpt = self._excerpts.begin(window, clients, begin)
        excerpt.until = until
        self._running[run] = excerpt
        self._requested[run] = event

    def release(self, run: ActionRun, until: int) -> None:
        """End the run's window at `until`; a run that is already over is left unchanged."""
        excerpt = self._running.get(run)
        if excerpt is not None and excerpt.until is not None:
            excerpt.until = min(excerpt.until, until)

    def change(self, before: CompiledRule, rule: CompiledRule, open_starts: Iterable[Event]) -> None:
        """The rule has other actions than before, and these episodes continue."""
        known, wanted = set(before.actions), set(rule.actions)
        if (known, before.dry_run) == (wanted, rule.dry_run):
            return
        gone = {action.name for action in known - wanted} if not rule.dry_run else {action.name for action in known}
        for run in [run for run in self._running if run.rule == rule.name and run.action in gone]:
            self._complete(run, REPLACED)
        new = [action for action in rule.actions if action not in known or before.dry_run]
        for event in open_starts:
            self.begin(new, rule, event, resumed=True)

    def drain(self, now: int) -> list[Consequence]:
        """Remove and return the messages for the actions, up to the engine's time `now`; nanoseconds."""
        if self._running:
            self._excerpts.distribute()
            for run, excerpt in list(self._running.items()):
                if excerpt is not None:
                    if samples := excerpt.drain(now):
                        self._noted.append(RunSamples(run, samples))
                    if excerpt.until is not None and now >= excerpt.until:
                        self._complete(run, "")
        if self._complete_ones:
            self._count_late(now)
        noted, self._noted = self._noted, []
        return noted

    def _count_late(self, now: int) -> None:
        self._excerpts.distribute()
        for excerpt in self._complete_ones:
            self.too_late += len(excerpt.drain(now))
        while self._complete_ones and (
            len(self._complete_ones) > _WATCHED or now - (self._complete_ones[0].until or 0) > _WATCHED_FOR
        ):
            self._excerpts.stop(self._complete_ones.popleft())

    def cut(self, now: int, why: str) -> list[Consequence]:
        """The same, and complete all runs, because the detector stops."""
        noted = self.drain(now)
        for run in list(self._running):
            self._complete(run, why)
        return noted + self.drain(now)

    @property
    def running(self) -> Mapping[ActionRun, Excerpt | None]:
        """The runs that are not complete yet."""
        return self._running

    def _end(self, run: ActionRun, event: Event) -> None:
        excerpt = self._running[run]
        if excerpt is not None and excerpt.until is not None:
            return  # it has ended already; its window is still open
        self._noted.append(EpisodeEnded(run, event))
        if excerpt is None or event.end_time is None:
            self._complete(run, "")
        else:
            excerpt.until = event.end_time + excerpt.window.after_ns

    def _complete(self, run: ActionRun, cut: str) -> None:
        excerpt = self._running.pop(run)
        begun = self._requested.pop(run, None)
        if begun is not None and excerpt is not None and not cut:
            self._noted.append(
                EpisodeEnded(run, msgspec.structs.replace(begun, end_time=excerpt.until, reason=EndReason.UNTIL))
            )
        if excerpt is not None and self.watch_late and not cut:
            self._complete_ones.append(excerpt)
        elif excerpt is not None:
            self._excerpts.stop(excerpt)
        self._noted.append(RunCompleted(run, cut))
