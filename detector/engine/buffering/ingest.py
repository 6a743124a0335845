"""Inserts samples into the buffer: finds the client and the lane of each sample.

Keys and clients come from outside, so their number is bounded: a publisher that invents names costs no more memory than
the bounds allow, and does not displace existing clients.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from operator import attrgetter

from detector.engine.buffering.buffer import NEVER, Buffer, Lane, bytes_of
from detector.engine.buffering.clients import Clients
from detector.engine.buffering.lanes import LaneMaker
from detector.engine.buffering.messages import KeyReader
from detector.engine.buffering.naming import MAXIMUM_ITEMS, MessageClients
from detector.engine.counters import Counters
from detector.engine.samples.liveliness import LIVELINESS, TokenState
from detector.engine.samples.sample import (
    SAMPLE_OVERHEAD,
    Arrival,
    Item,
    LinkedSample,
    PreviousSample,
    Sample,
    StampedSample,
)
from wayside.api import Detector

MAXIMUM_CLIENTS = 100_000
"""Maximum number of known clients; samples of further ones are dropped and counted."""

MAXIMUM_OBJECTS = 50_000
"""Items add no new clients beyond this number of known clients: the rest is reserved for vehicles."""

MAXIMUM_KEYS = 200_000
"""Maximum number of cached keys per stream; further keys are parsed each time, which is only slower."""

MAXIMUM_LOST = 1_000
"""Maximum number of lost clients whose newest samples are kept in case they return; the oldest are dropped first."""

_STREAM = attrgetter("stream")

_BY_CLIENT = "/"
"""Prefix of the cache entries of lanes that are not found by key: no key begins with a slash."""

_NO_LANES: Mapping[str, Lane] = {}


class Ingest:
    """Puts arrivals into the lanes of their clients and streams."""

    def __init__(self, buffer: Buffer, clients: Clients, counters: Counters) -> None:
        self._buffer = buffer
        self._clients = clients
        self._counters = counters
        self._number = 0
        self._newest = NEVER
        """The greatest time of all samples until now: no sample with this time or a later one is late in any lane."""
        self.inserted: list[Sample] = []
        """Samples inserted since tables were last updated, while `collecting`."""
        self.lanes: list[Lane] = []
        """The lane of each sample in `inserted`."""
        self.collecting = False
        self.linked: frozenset[str] = frozenset()
        """The streams whose samples keep the previous one, because some rule reads it."""
        self._lost: dict[str, None] = {}
        """The lost clients whose samples are kept, in the order of their loss."""

    def configure(
        self,
        detector: Detector,
        read_key: KeyReader,
        lane_makers: Mapping[str, LaneMaker],
        message_clients: MessageClients,
    ) -> None:
        """Use the streams of this Detector from now on; `lane_makers` has one for each."""
        self._message_clients = message_clients
        self._read_key = read_key
        self._lane_makers = lane_makers
        self._of_items = frozenset(stream.name for stream in detector.spec.streams if stream.items is not None)
        self._stale_after = {stream.name: detector.spec.stale_after_ns(stream) for stream in detector.spec.streams}
        timeout = detector.spec.client_timeout.ns
        self._item_timeouts = {stream: min(self._stale_after[stream] or timeout, timeout) for stream in self._of_items}
        """By stream with items, how long a client known only from such items stays known without one; nanoseconds."""
        self._lanes: dict[str, dict[str, Lane]] = {stream.name: {} for stream in detector.spec.streams}
        """By key; of streams whose messages name their client, by client: see `_lane_of_message`."""

    def insert(self, arrivals: Sequence[Arrival], times: Sequence[int] | None, size: int) -> None:
        """Insert everything that was received.

        `times`: None for the receive times, in order. `size`: an upper bound of the arrivals' memory, see `size_of`.
        """
        streams = {arrival.stream for arrival in arrivals}
        if len(streams) == 1:
            self._counters.samples[arrivals[0].stream] += len(arrivals)
        else:
            self._counters.samples.update(map(_STREAM, arrivals))
        if times is None and self._of_items.isdisjoint(streams) and self.linked.isdisjoint(streams):
            self._insert_in_order(arrivals, size)
            return
        for at, arrival in enumerate(arrivals):
            stream, key, payload = arrival.stream, arrival.key, arrival.payload
            time = arrival.received if times is None else times[at]
            self._newest = max(self._newest, time)
            if stream in self._of_items:
                self._insert_items(arrival, time)
                continue
            lane = self._lane(stream, key, time, payload)
            if lane is not None:
                self._number += 1
                if stream in self.linked:
                    self._put(lane, LinkedSample(time, self._number, payload, key, self._before(lane, time)))
                else:
                    self._put(lane, arrival if times is None else StampedSample(time, self._number, payload, key))

    def size_of(self, arrivals: Sequence[Arrival]) -> int:
        """An upper bound of the memory that the arrivals take in the buffer, in bytes; their items may take less."""
        size = bytes_of(arrivals)
        if self._of_items:
            size += MAXIMUM_ITEMS * SAMPLE_OVERHEAD * sum(arrival.stream in self._of_items for arrival in arrivals)
        return size

    def _insert_items(self, arrival: Arrival, time: int) -> None:
        """Insert each item of a message into the lane of its client."""
        stream, key, payload = arrival.stream, arrival.key, arrival.payload
        self._number += 1
        found = self._read_items(stream, key, payload)
        share = len(payload) // max(len(found), 1)
        for client, place in found.items():
            name = _BY_CLIENT + client
            lane = self._lanes[stream].get(name) or self._new_lane(stream, name, client, time)
            if lane is not None:
                before = self._before(lane, time) if stream in self.linked else None
                self._put(lane, Item(time, self._number, payload, key, place, share, before))

    def _before(self, lane: Lane, time: int) -> PreviousSample | None:
        """The newest sample in the buffer up to a time; None if it is stale at that time."""
        newest = lane.newest
        if newest is not None and newest.time > time:
            newest = next((sample for sample in reversed(lane.samples) if sample.time <= time), None)
        limit = self._stale_after[lane.stream]
        if newest is None or (limit is not None and time - newest.time > limit):
            return None
        return PreviousSample(newest.payload, newest.place if isinstance(newest, Item) else -1)

    def _put(self, lane: Lane, sample: Sample) -> None:
        self._buffer.grew(lane.insert(sample))
        if self.collecting:
            self.inserted.append(sample)
            self.lanes.append(lane)

    def _insert_in_order(self, arrivals: Sequence[Arrival], size: int) -> None:
        """The hot path: `_put` is inlined for arrivals that are not late and evict nothing."""
        known, buffer, newest = self._lanes, self._buffer, self._newest
        self._newest = max(newest, arrivals[-1].received)
        lanes: list[Lane]
        try:
            lanes = [known[arrival.stream][arrival.key] for arrival in arrivals]
        except KeyError:
            found = [(self._lane(each.stream, each.key, each.received, each.payload), each) for each in arrivals]
            arrivals = [arrival for lane, arrival in found if lane is not None]
            lanes = [lane for lane, _ in found if lane is not None]
            size = bytes_of(arrivals)
        if not buffer.has_room(size) or (arrivals and arrivals[0].received < newest):
            for lane, arrival in zip(lanes, arrivals, strict=True):
                self._put(lane, arrival)
            return
        for lane, arrival in zip(lanes, arrivals, strict=True):
            if lane.capped:
                size += lane.insert(arrival) - lane.size_of(arrival)
            else:
                lane.samples.append(arrival)
                lane.bytes += len(arrival.payload) + SAMPLE_OVERHEAD
        buffer.bytes += size
        if self.collecting:
            self.inserted += arrivals
            self.lanes += lanes

    def _lane(self, stream: str, key: str, time: int, payload: bytes) -> Lane | None:
        """The lane for a sample; None if there is none: the sample is then dropped, and not counted in `samples`."""
        if stream in self._message_clients:
            lane = self._lane_of_message(stream, key, time, payload)
        else:
            lane = self._lanes.get(stream, _NO_LANES).get(key) or self._route(stream, key, time)
        if lane is None:
            self._counters.samples[stream] -= 1
            if stream == LIVELINESS:
                self._token(key, payload, time)
        return lane

    def sender_of(self, arrival: Arrival) -> str | None:
        """The sender of the arrival: its client; for a message with items its key; None as in `clients_of`."""
        if arrival.stream in self._of_items:
            return _BY_CLIENT + arrival.key
        return self._client_of(arrival)

    def clients_of(self, arrival: Arrival) -> Collection[str]:
        """The clients of the arrival; none, and counted, if neither its key nor its message names a valid client."""
        if arrival.stream in self._of_items:
            return self._read_items(arrival.stream, arrival.key, arrival.payload)
        client = self._client_of(arrival)
        return () if client is None else (client,)

    def _client_of(self, arrival: Arrival) -> str | None:
        if arrival.stream in self._message_clients:
            return self._read_message(arrival.stream, arrival.key, arrival.payload)
        lane = self._lanes.get(arrival.stream, _NO_LANES).get(arrival.key)
        return lane.client if lane is not None else self._read(arrival.stream, arrival.key)

    def step_back(self, to: int) -> None:
        """Time continues from `to` (nanoseconds), which is earlier."""
        self._newest = to

    def forget_clients(self, lost: Collection[str]) -> None:
        """Forget lost clients. If one returns, its last samples are still available.

        A latched sample would not be sent again, since its sender may not have noticed the loss.
        """
        for lanes in self._lanes.values():
            for key in [key for key, lane in lanes.items() if lane.client in lost]:
                del lanes[key]
        for client in lost if self._of_items else ():
            self._buffer.forget(client, self._of_items)  # a later item of that name is another object
        self._lost.update(dict.fromkeys(lost))
        while len(self._lost) > MAXIMUM_LOST:
            client = next(iter(self._lost))
            del self._lost[client]
            self._buffer.forget(client)

    def _token(self, key: str, payload: bytes, time: int) -> None:
        """Handle a change of a client's liveliness token."""
        try:
            token = TokenState(payload)
        except ValueError:
            self._counters.unnamed[LIVELINESS] += 1
            return
        tokens = self._clients.tokens
        if token is not TokenState.DECLARED:
            client = tokens.withdraw(key, lost=token is TokenState.DROPPED)
            if client is not None:
                self._clients.still_present(client, time)  # the timeout counts from here
            return
        parsed = self._read_key(LIVELINESS, key)
        if parsed is None:
            self._unnamed(LIVELINESS, key)
        elif (parsed[0] not in self._clients and len(self._clients) >= MAXIMUM_CLIENTS) or not tokens.declare(
            key, parsed[0]
        ):
            self._counters.crowded[LIVELINESS] += 1
        else:
            self._lost.pop(parsed[0], None)
            self._clients.note_presence(parsed[0], time)

    def _route(self, stream: str, key: str, time: int) -> Lane | None:
        """The lane for a key that is not cached: a new key, or one of a client that was lost."""
        if stream == LIVELINESS:
            return None
        client = self._read(stream, key)
        return None if client is None else self._new_lane(stream, key, client, time)

    def _lane_of_message(self, stream: str, key: str, time: int, payload: bytes) -> Lane | None:
        """The lane for a message that names its client."""
        client = self._read_message(stream, key, payload)
        if client is None:
            return None
        name = _BY_CLIENT + client
        return self._lanes[stream].get(name) or self._new_lane(stream, name, client, time)

    def _new_lane(self, stream: str, key: str, client: str, time: int) -> Lane | None:
        """A lane to cache under the key; None, and counted, if there are too many clients."""
        of_items = stream in self._of_items
        maximum = MAXIMUM_OBJECTS if of_items else MAXIMUM_CLIENTS
        if client not in self._clients and len(self._clients) >= maximum:
            self._counters.crowded[stream] += 1
            return None
        lane = self._buffer.add(self._lane_makers[stream].lane(client))
        if len(self._lanes[stream]) >= MAXIMUM_KEYS:
            self._lanes[stream].clear()
        self._lanes[stream][key] = lane
        self._lost.pop(client, None)
        self._clients.note_presence(client, time, self._item_timeouts.get(stream))
        return lane

    def _read_items(self, stream: str, key: str, payload: bytes) -> dict[str, int]:
        """The clients of a message's items, and their indices in the list."""
        parsed = self._read_key(stream, key)
        if parsed is None:
            self._unnamed(stream, key)
            return {}
        return self._message_clients.of_items(stream, key, parsed[1], payload)

    def _read(self, stream: str, key: str) -> str | None:
        parsed = self._read_key(stream, key) if stream in self._lane_makers else None
        if parsed is None:  # including messages of a stream that the Detector no longer has
            self._unnamed(stream, key)
            return None
        return parsed[0]

    def _unnamed(self, stream: str, key: str) -> None:
        self._counters.unnamed[stream] += 1
        self._counters.last_unnamed[stream] = (
            f"{key}: client: the captured name must have 1 to 63 of A-Z a-z 0-9 . _ : -"
        )

    def _read_message(self, stream: str, key: str, payload: bytes) -> str | None:
        parsed = self._read_key(stream, key)
        if parsed is None:
            self._unnamed(stream, key)
            return None
        return self._message_clients.client(stream, key, parsed[1], payload)
