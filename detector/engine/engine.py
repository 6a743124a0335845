"""The engine: arrivals and the time go in, events come out, and the demands of what is open can be asked for.

It reads no clock and does no I/O. Live operation, the replay of a recording and the tests call the same four methods
(`advance`, `gap`, `set_rules`, `restore`), always from one thread; the same calls give the same events, ids included.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Protocol

from detector.engine.buffer import Buffer, Lane
from detector.engine.clients import Clients
from detector.engine.counters import Counters
from detector.engine.demands import Demand
from detector.engine.episodes import Reason
from detector.engine.evaluation import Identity, RuleRun, same_semantics
from detector.engine.events import Event
from detector.engine.sample import Arrival, DecodeError, Decoder, Sample
from detector.engine.scopes import Views
from detector.engine.signals import Messages, Signals
from detector.engine.timeline import DataTimeline, Gap, Insert, Step, Tick, Ticks, Timeline, WallTimeline
from wayside.api import Detector
from wayside.api.detector import Clock, Stream
from wayside.expressions import EvaluationError
from wayside.rules import CompiledRule, CompiledStream, compile_stream

_new_sample = tuple.__new__
"""Makes a Sample from a plain tuple at a third of the cost of calling the class: it is made for every message."""

_NO_LANES: Mapping[str, Lane] = {}


class KeyReader(Protocol):
    """Tells whose a sample is."""

    def __call__(self, stream: str, key: str) -> tuple[str, Mapping[str, str]] | None:
        """The client and the captured chunks; None where the key names no valid client."""


class Engine:
    """Buffers samples, evaluates rules at their ticks and keeps the episodes."""

    def __init__(
        self,
        detector: Detector,
        *,
        holder: str,
        decoders: Mapping[str, Decoder],
        read_key: KeyReader,
        start: int,
    ) -> None:
        """`start` is when the detector started, in nanoseconds since the epoch; `decoders` has one for each stream.

        Raises:
            RuleError: an expression of one of the Detector's streams does not compile.
        """
        self.identity = Identity(detector.name, holder, detector.namespace)
        self.counters = Counters()
        self._number = 0
        self._runs: dict[str, RuleRun] = {}
        self._rules_version = 0
        self._ticks = Ticks()
        self.buffer = Buffer(detector.spec.buffer.bytes.bytes)
        self.clients = Clients({}, detector.spec.client_timeout.ns)
        self._configure(detector, decoders, read_key)
        self._timeline = self._make_timeline(start)

    def set_detector(self, detector: Detector, decoders: Mapping[str, Decoder], read_key: KeyReader) -> None:
        """Go on with a changed Detector; call `set_rules` afterwards, with the rules compiled against it.

        Samples of streams that are read as before stay, and so do open episodes. A change of the clock begins a new
        time axis: the buffer is emptied, what was pending is forgotten.

        Raises:
            RuleError: an expression of one of the Detector's streams does not compile; nothing has changed then.
        """
        before = self.detector.spec
        self._configure(detector, decoders, read_key)
        kept = {stream.name for stream in detector.spec.streams if _reads_like(stream, before.stream(stream.name))}
        self.buffer.keep(kept)
        for lane in self.buffer:
            stream = self._streams[lane.stream]
            lane.duration = detector.spec.buffer_duration_ns(stream)
            lane.maximum_bytes = None if stream.buffer.bytes is None else stream.buffer.bytes.bytes
        times = (detector.spec.clock, detector.spec.lateness, detector.spec.max_ahead)
        if times != (before.clock, before.lateness, before.max_ahead):
            now = self._timeline.now
            self._timeline = self._make_timeline(now)
            self._gap(now, backwards=detector.spec.clock is not before.clock)

    def _configure(self, detector: Detector, decoders: Mapping[str, Decoder], read_key: KeyReader) -> None:
        spec = detector.spec
        self._stamps: dict[str, CompiledStream] = {
            stream.name: compile_stream(stream, index) for index, stream in enumerate(spec.streams)
        }
        self.detector = detector
        self.buffer.maximum_bytes = spec.buffer.bytes.bytes
        self.clients.configure({c.name: c.labels for c in spec.clients}, spec.client_timeout.ns)
        self._read_key = read_key
        self._decoders = decoders
        self._messages = Messages(decoders, self.counters)
        self._stale_after = {stream.name: spec.stale_after_ns(stream) for stream in spec.streams}
        self._signals = Signals(self.buffer, self.clients, self._messages, self._stale_after)
        self._streams = {stream.name: stream for stream in spec.streams}
        self._lanes: dict[str, dict[str, Lane]] = {stream.name: {} for stream in spec.streams}

    def advance(self, arrivals: Sequence[Arrival], until: int) -> list[Event]:
        """Take in what arrived, in order, none after `until`, and run the ticks up to there."""
        return self._run(self._timeline.steps(arrivals, until))

    def gap(self, time: int) -> list[Event]:
        """The wall clock stood still or jumped: go on from `time`; windows begin anew, open episodes hold."""
        return self._run(self._timeline.gap(time))

    def set_rules(self, rules: Sequence[CompiledRule]) -> list[Event]:
        """Evaluate these rules from now on. Episodes of rules that are gone or mean something else end."""
        now = self._timeline.now
        new = {rule.name: rule for rule in rules}
        events: list[Event] = []
        runs: dict[str, RuleRun] = {}
        for name, run in sorted(self._runs.items()):
            rule = new.get(name)
            if rule is None or not same_semantics(run, rule):
                events += run.end_all(now, Reason.RULE_CHANGED)
            else:
                run.change_actions(rule)
                runs[name] = run
        for name, rule in new.items():
            if name not in runs:
                runs[name] = RuleRun(rule, self.identity, self.counters.rule(name))
        self._runs = dict(sorted(runs.items()))
        self._signals.forget(lambda rule, client: rule in runs)
        self._ticks.set_periods([rule.every_ns for rule in rules if rule.enabled])
        self._rules_version += 1
        return events

    def restore(self, demands: Sequence[Demand], now: int) -> list[Event]:
        """Take up the episodes that were open before a restart; those whose rule changed meanwhile end."""
        episodes: dict[tuple[str, str], list[Demand]] = {}
        for demand in demands:
            episodes.setdefault((demand.rule, demand.episode), []).append(demand)
        events: list[Event] = []
        for (name, _), of_one in sorted(episodes.items()):
            run = self._runs.get(name)
            if run is not None and run.rule.enabled and run.rule.digest == of_one[0].rule_digest:
                run.restore(of_one)
                for client in of_one[0].subjects:
                    self.clients.heard(client, now)
            else:
                events.append(_ended_while_away(of_one[0], now))
        self._rules_version += 1
        return events

    def demands(self) -> dict[str, Demand]:
        """What the open episodes ask for, by the names of the tasks."""
        return {demand.name: demand for run in self._runs.values() for demand in run.demands()}

    @property
    def demands_version(self) -> tuple[int, int]:
        """Changes whenever the demands do, so that they need be asked for only then."""
        return self._rules_version, sum(run.version for run in self._runs.values())

    def next_tick(self) -> int:
        """When the next tick is due, with clock Wall; nanoseconds since the epoch."""
        return self._ticks.after(self._timeline.now)

    @property
    def now(self) -> int:
        """Up to here all ticks have run; nanoseconds on the engine's time axis."""
        return self._timeline.now

    @property
    def on_wall_clock(self) -> bool:
        """Whether the shell says how far time has come; else the samples do."""
        return isinstance(self._timeline, WallTimeline)

    @property
    def timeline(self) -> Timeline:
        """The time axis; with clock Data it counts what it dropped."""
        return self._timeline

    @property
    def rules(self) -> Mapping[str, RuleRun]:
        """The rules that are evaluated, by name."""
        return self._runs

    def _run(self, steps: Iterable[Step]) -> list[Event]:
        events: list[Event] = []
        for step in steps:
            match step:
                case Insert(arrivals, times):
                    self._insert(arrivals, times)
                case Tick(time):
                    events += self._tick(time)
                case Gap(time, backwards):
                    self._gap(time, backwards)
        return events

    def _insert(self, arrivals: Sequence[Arrival], times: Sequence[int] | None) -> None:
        """The hot path: everything that is received comes through here."""
        lanes, buffer, first = self._lanes, self.buffer, self._number
        for index, arrival in enumerate(arrivals):
            received, stream, key, payload = arrival
            if times is not None:
                received = times[index]  # with clock Data, there is no other time
            lane = lanes.get(stream, _NO_LANES).get(key)
            if lane is None:
                lane = self._route(stream, key, received)
                if lane is None:
                    continue
            self._number += 1
            buffer.grew(lane.insert(_new_sample(Sample, (received, self._number, payload, received, key))))
            self.counters.samples[stream] += 1
            if times is not None:
                self.clients.heard(lane.client, received)
        if times is None:
            for lane in buffer:
                newest = lane.newest
                if newest is not None and newest.number > first:
                    self.clients.heard(lane.client, newest.time)

    def _route(self, stream: str, key: str, time: int) -> Lane | None:
        """The lane for a key that has none at hand: a new key, or one of a client that was lost."""
        spec = self._streams.get(stream)
        whose = None if spec is None else self._read_key(stream, key)
        if spec is None or whose is None:
            self.counters.unnamed[stream] += 1  # also what still came in on a stream that the Detector no longer has
            return None
        client, captures = whose
        limit = spec.buffer.bytes
        lane = self.buffer.add(
            Lane(
                client,
                stream,
                captures,
                self.detector.spec.buffer_duration_ns(spec),
                None if limit is None else limit.bytes,
            )
        )
        self._lanes[stream][key] = lane
        self.clients.heard(client, time)
        return lane

    def _tick(self, time: int) -> list[Event]:
        self.buffer.expire(time)
        lost = self.clients.lose(time)
        if lost:
            self._unroute(set(lost))
        events: list[Event] = []
        for run in self._runs.values():
            if run.due(time):
                views = Views(run.rule, time, self.clients, self.buffer, self._signals, self._stale_after, run.counters)
                events += run.tick(time, views, self.clients)
        self._messages.forget()
        return events

    def _gap(self, time: int, backwards: bool) -> None:
        if backwards:
            self.buffer.clear()
        self._signals.gap(time)
        self.clients.gap(time)
        for run in self._runs.values():
            run.gap(time)

    def _unroute(self, lost: set[str]) -> None:
        """The next sample of a lost client makes it known again; its latched samples are still there then."""
        for lanes in self._lanes.values():
            for key in [key for key, lane in lanes.items() if lane.client in lost]:
                del lanes[key]
        self._signals.forget(lambda rule, client: client in self.clients)

    def _make_timeline(self, start: int) -> Timeline:
        spec = self.detector.spec
        if spec.clock is Clock.WALL:
            return WallTimeline(self._ticks, start)
        longest = max(spec.buffer_duration_ns(stream) for stream in spec.streams)
        return DataTimeline(
            self._ticks,
            lateness=spec.lateness.ns,
            max_ahead=spec.max_ahead.ns,
            max_behind=longest,
            stamp_of=self._stamp_of,
            client_of=self._client_of,
        )

    def _client_of(self, arrival: Arrival) -> str | None:
        lane = self._lanes.get(arrival.stream, _NO_LANES).get(arrival.key)
        if lane is not None:
            return lane.client
        whose = self._read_key(arrival.stream, arrival.key) if arrival.stream in self._streams else None
        if whose is None:
            self.counters.unnamed[arrival.stream] += 1
            return None
        return whose[0]

    def _stamp_of(self, arrival: Arrival) -> int | None:
        """The sender's time in nanoseconds; the receive time where the message carries none."""
        stream = arrival.stream
        decoder, stamp = self._decoders[stream], self._stamps[stream].stamp
        try:
            if stamp is None:
                own = decoder.stamp(arrival.payload)
                return arrival.received if own is None else own
            return _nanoseconds(stamp.evaluate({"msg": decoder.decode(arrival.payload)}))
        except (DecodeError, EvaluationError, ValueError) as error:
            self.counters.undecodable[stream] += 1
            self.counters.last_undecodable[stream] = str(error)
            return None


def _reads_like(stream: Stream, before: Stream | None) -> bool:
    """Whether samples taken in before can be read as ones of the stream."""
    return before is not None and (stream.key, stream.client, stream.encoding, stream.type) == (
        before.key,
        before.client,
        before.encoding,
        before.type,
    )


def _nanoseconds(seconds: object) -> int:
    """A stamp in seconds, to the microsecond: a double holds no more of a time since the epoch."""
    if not isinstance(seconds, int | float) or not 0 <= seconds < 1e11:
        raise ValueError(f"stamp {seconds!r} is no time in seconds since the epoch")
    return round(seconds * 1e6) * 1000


def _ended_while_away(demand: Demand, now: int) -> Event:
    """The end of an episode whose rule changed or went while the detector was not running."""
    return Event(
        holder=demand.holder,
        rule=demand.rule,
        subject=demand.subject,
        subjects=demand.subjects,
        episode=demand.episode,
        onset_time=demand.onset_time,
        start_time=demand.start_time,
        end_time=now,
        reason=Reason.RULE_CHANGED,
        values={},
        classification=demand.classification,
    )
