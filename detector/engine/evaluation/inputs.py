"""The inputs of rules: the clients and their samples, how to read them, and the values computed from them.

They follow changes of the Detector. Each call passes the time; rules and episodes are kept elsewhere.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from detector.engine.buffering.buffer import HOUSEKEEPING, Buffer
from detector.engine.buffering.clients import Clients
from detector.engine.buffering.ingest import Ingest
from detector.engine.buffering.items import Items
from detector.engine.buffering.lanes import lane_makers
from detector.engine.buffering.messages import KeyReader, Messages
from detector.engine.buffering.naming import MessageClients, PossibleStreams
from detector.engine.columns.block import Context
from detector.engine.columns.tables import Tables
from detector.engine.counters import Counters
from detector.engine.evaluation.rule import RuleRun
from detector.engine.queries.queries import BufferQueries
from detector.engine.queries.transforms import Transforms, TransformStream
from detector.engine.samples.sample import Arrival, Decoder, Sample
from detector.engine.scoping.positions import PositionLookup
from detector.engine.scoping.scopes import Views
from detector.engine.signals.signals import Signals
from detector.engine.signals.starts import EpisodeStarts
from wayside.api import Detector
from wayside.api.stream import Encoding, Stream
from wayside.rules import compile_stream

_SAMPLE = frozenset({"sample"})

_DEFINED = (Encoding.CDR, Encoding.UPER)
"""Encodings that need message definitions."""


class RuleInputs:
    """The buffer, the clients, and the signals and positions that rules read."""

    def __init__(
        self,
        detector: Detector,
        decoders: Mapping[str, Decoder],
        read_key: KeyReader,
        start: int,
        counters: Counters,
        starts: EpisodeStarts,
        *,
        exact: bool = True,
    ) -> None:
        """`starts` are the episode starts that signals over rules read. `exact`: see `steps.ORDER`.

        Raises:
            RuleError: an expression of one of the Detector's streams does not compile.
        """
        self.buffer = Buffer(detector.spec.buffer.bytes.bytes)
        self.clients = Clients(self.buffer)
        self.ingest = Ingest(self.buffer, self.clients, counters)
        self._counters = counters
        self._starts = starts
        self._exact = exact
        self._rows_forgotten = start
        self._floor: int | None = None
        """Windows start after the last gap; nanoseconds."""
        self._configure(detector, decoders, read_key, start)

    def follow(self, detector: Detector, decoders: Mapping[str, Decoder], read_key: KeyReader, now: int) -> None:
        """Switch to a changed Detector. Samples of streams that are read as before are kept.

        Raises:
            RuleError: an expression of one of its streams does not compile; the state is then unchanged.
        """
        before = self.detector.spec
        self._configure(detector, decoders, read_key, now)
        defined_alike = (detector.spec.messages, detector.spec.asn1) == (before.messages, before.asn1)
        kept = {
            stream.name
            for stream in detector.spec.streams
            if _reads_like(stream, before.stream(stream.name)) and (defined_alike or stream.encoding not in _DEFINED)
        }
        self.buffer.retain(kept)
        self.tables.forget()
        if detector.spec.zenoh.liveliness != before.zenoh.liveliness:
            for client in self.clients.tokens.forget():
                self.clients.still_present(client, now)
        for lane in self.buffer:
            self._lane_makers[lane.stream].limit(lane)

    def _configure(self, detector: Detector, decoders: Mapping[str, Decoder], read_key: KeyReader, now: int) -> None:
        spec = detector.spec
        compiled = {stream.name: compile_stream(stream, index) for index, stream in enumerate(spec.streams)}
        self.detector = detector
        self.buffer.maximum_bytes = spec.buffer.bytes.bytes
        self.clients.configure(
            {client.name: client.labels for client in spec.clients},
            spec.client_timeout.ns,
            {client.name for client in spec.clients if client.expected},
            now,
        )
        self._lane_makers = lane_makers(detector, decoders)
        items = Items(decoders, compiled)
        names = MessageClients(decoders, compiled, items, self._counters)
        self.ingest.configure(detector, read_key, self._lane_makers, names)
        self.messages = Messages(decoders, compiled, read_key, items, self._counters)
        self.transforms = Transforms(_transform_streams(detector), self.buffer, self.messages, self._counters)
        self._stale_after = {stream.name: spec.stale_after_ns(stream) for stream in spec.streams}
        possible = PossibleStreams(spec.streams)
        self.signals = Signals(
            self.buffer, self.clients, self.messages, self._stale_after, self._starts, possible, self._floor
        )
        self._positions = PositionLookup(self.buffer, self.messages, self._stale_after, possible, self._floor)
        self.tables = Tables(self.buffer)
        self.tables.configure(detector, decoders, self.messages, self._counters)
        self.context = Context(
            self.tables,
            self.clients,
            self._stale_after,
            possible,
            self._positions,
            self._starts,
            self.signals,
            self._exact,
        )
        """The inputs of rules in columns; replaced with each change of the Detector."""

    @property
    def floor(self) -> int | None:
        """Windows start after this time; nanoseconds."""
        return self._floor

    def update_tables(self) -> None:
        """Add the samples that entered the buffer to the tables, and drop those that it evicted."""
        ingest = self.ingest
        self.tables.update(ingest.inserted, ingest.lanes)
        ingest.inserted, ingest.lanes = [], []
        ingest.collecting = not self.tables.empty

    def forget_rows(self, now: int) -> None:
        """Drop table rows that are no longer needed, once a second: all ticks up to `now` (nanoseconds) have run."""
        if not 0 <= now - self._rows_forgotten < HOUSEKEEPING:
            self._rows_forgotten = now
            self.tables.expire(now - now % HOUSEKEEPING)

    def new_tables(self) -> None:
        """Create new tables: rules that are evaluated in columns must be set again."""
        tables = self.tables
        self.tables = Tables(self.buffer)
        self.tables.follow(tables)
        self.context = self.context._replace(tables=self.tables)

    def expire(self, time: int) -> list[str]:
        """Remove lost clients and, at whole seconds, expired samples; returns the lost clients."""
        if time % HOUSEKEEPING == 0:  # not at rule ticks: evictions must not depend on rules
            if self.tables.behind:
                self.update_tables()  # while the buffer still has what the queued ticks read
            self.buffer.expire(time)
        lost = self.clients.remove_lost(time) if self.clients.may_remove(time) else []
        if lost:
            self.ingest.forget_clients(set(lost))
            self.signals.forget(lambda rule, client: client in self.clients)
        return lost

    def gap(self, time: int, backwards: bool) -> None:
        """Time jumped to `time`, forwards or `backwards`, without ticks: later windows start after it."""
        if backwards:
            self.buffer.step_back(time)
            self.ingest.step_back(time)
            self.tables.forget()
        self._floor = time
        self.signals.gap(time)
        self._positions.gap(time)
        self.clients.gap(time)

    def end_tick(self, now: int) -> None:
        """Drop the messages and transforms that were decoded for the tick."""
        self.messages.forget()
        self.transforms.forget(now)

    def stamp_of(self, arrival: Arrival) -> int | None:
        """The arrival's time with clock Data; None if it cannot be read, which is counted."""
        return self.messages.time(arrival.stream, arrival.key, arrival.received, arrival.payload)

    def sampled(self, arrivals: Sequence[Arrival]) -> Mapping[str, frozenset[str]]:
        """By stream, the known clients that sent these samples."""
        found: dict[str, set[str]] = {}
        for arrival in arrivals:
            for client in self.ingest.clients_of(arrival):
                if client in self.clients:
                    found.setdefault(arrival.stream, set()).add(client)
        return {stream: frozenset(clients) for stream, clients in found.items()}

    def latency(self, sample: Sample, stream: str) -> float | None:
        """Seconds from the sample's stamp to its receipt; None if it has no stamp. Counts nothing."""
        values = self.messages.values(stream, sample, _SAMPLE, {})
        latency = None if values is None else values["sample"].get("latency")
        return latency if isinstance(latency, float) else None

    def views(self, run: RuleRun, time: int) -> Views:
        """The values that a rule can read at a time."""
        return Views(
            run.rule,
            time,
            self.clients,
            self.buffer,
            self.signals,
            self._positions,
            self._stale_after,
            run.counters,
            exact=self._exact,
        )

    def queries(self, now: int) -> BufferQueries:
        """Read access to the buffer."""
        return BufferQueries(
            now, self._floor, self.buffer, self.clients, self.messages, self._stale_after, self.transforms
        )

    def forget_rules(self, kept: Collection[str]) -> None:
        """Forget the signals of all rules except these."""
        self.signals.forget(lambda rule, client: rule in kept)


def _transform_streams(detector: Detector) -> list[TransformStream]:
    return [
        TransformStream(stream.name, stream.latched, stream.frame_prefix or "")
        for stream in detector.spec.streams
        if stream.carries_transforms
    ]


def _reads_like(stream: Stream, before: Stream | None) -> bool:
    """Whether samples taken in earlier can be read as samples of the stream."""
    return before is not None and _reading(stream) == _reading(before)


def _reading(stream: Stream) -> tuple[object, ...]:
    return stream.key, stream.client, stream.items, stream.encoding, stream.type, stream.latched
