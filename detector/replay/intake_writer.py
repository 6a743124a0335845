"""Writes an intake file beside a running engine, which never waits for the disk.

A bounded queue passes the data to a separate thread. If the disk is too slow and the queue is full, arrivals are
dropped; the drop is counted, logged and marked in the file, and the replay is inexact.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from mcap.writer import Writer

from detector.engine.samples.sample import Arrival
from detector.replay.intake_file import CONTROL_TOPIC, LIBRARY, STREAM, Control
from detector.streams.codecs.ros import RosTypes, standard
from wayside.api.stream import Stream

log = logging.getLogger(__name__)

_FLUSH_SECONDS = 0.8
"""Maximum seconds until data is passed to the kernel: about the loss caused by a kill -9."""
_OVERHEAD = 100
"""Bytes that an arrival takes in the queue in addition to its payload."""
_MAX_CHANNELS = 60_000
"""MCAP numbers channels with 16 bits; messages on further keys are left out."""


class _Streams(NamedTuple):
    """The Detector's streams from here on."""

    streams: tuple[Stream, ...]
    types: RosTypes


class _Arrivals(NamedTuple):
    """Samples, and their bytes in the queue."""

    arrivals: Sequence[Arrival]
    size: int


class IntakeWriter:
    """Receives the engine's input, from one thread at a time, and writes it on another."""

    def __init__(
        self,
        path: Path,
        streams: Iterable[Stream] = (),
        types: RosTypes | None = None,
        *,
        maximum_bytes: int = 256 * 2**20,
    ) -> None:
        """`streams` and `types` give the format of the messages, for other tools to open the file. Raises OSError."""
        self._path = path
        self._mcap = _Mcap(path)
        self._queue: list[_Arrivals | Control | _Streams] = [_Streams(tuple(streams), types or standard())]
        self._bytes = 0
        self._maximum_bytes = maximum_bytes
        self._changed = threading.Condition()
        self._closing = False
        self._unmarked = 0
        self._unmarked_since = 0
        self.lost = 0
        """Number of arrivals missing from the file, and therefore from its replay."""
        self.error: Exception | None = None
        """Why writing ended early, if it did."""
        self._thread = threading.Thread(target=self._run, name="intake-writer", daemon=True)
        self._thread.start()

    def follow(self, streams: Iterable[Stream], types: RosTypes) -> None:
        """The Detector changed: the following messages belong to these streams."""
        self._append(_Streams(tuple(streams), types))

    def arrivals(self, arrivals: Sequence[Arrival]) -> None:
        """Samples that the engine takes in now. Never waits; if the queue is full, they are dropped and counted."""
        size = sum(len(arrival.payload) for arrival in arrivals) + _OVERHEAD * len(arrivals)
        with self._changed:
            if self.error is not None or self._bytes + size > self._maximum_bytes:
                self._leave_out(arrivals)
                return
            self._mark_lost()
            self._bytes += size
            self._queue.append(_Arrivals(arrivals, size))
            self._changed.notify()

    def control(self, time: int, document: Mapping[str, Any]) -> None:
        """Another input of the engine, at a time in nanoseconds. These are few: none is dropped."""
        self._append(Control(time, dict(document)))

    def close(self) -> None:
        """Writes the queued data and completes the file; otherwise it can be read up to about the last second."""
        with self._changed:
            self._mark_lost()
            self._closing = True
            self._changed.notify()
        self._thread.join()

    def _append(self, item: Control | _Streams) -> None:
        with self._changed:
            if self.error is None:
                self._mark_lost()
                self._queue.append(item)
                self._changed.notify()

    def _leave_out(self, arrivals: Sequence[Arrival]) -> None:
        if not self._unmarked and arrivals:
            self._unmarked_since = arrivals[0].received
            if self.error is None:
                log.error("%s: writing is too slow; dropping samples, so its replay will differ", self._path)
        self._unmarked += len(arrivals)
        self.lost += len(arrivals)

    def _mark_lost(self) -> None:
        if self._unmarked:
            self._queue.append(Control(self._unmarked_since, {"kind": "lost", "arrivals": self._unmarked}))
            self._unmarked = 0

    def _run(self) -> None:
        try:
            self._write()
        except Exception as error:  # noqa: BLE001  any error ends the recording, and is logged
            log.error("%s: writing failed; the recording ends here: %s", self._path, error)
            with self._changed:
                self.error = error
                self._queue.clear()

    def _write(self) -> None:
        flushed, closing = time.monotonic(), False
        with self._mcap as mcap:
            while not closing:
                with self._changed:
                    self._changed.wait_for(
                        lambda: self._queue or self._closing, max(0.0, flushed + _FLUSH_SECONDS - time.monotonic())
                    )
                    queue, self._queue = self._queue, []
                    closing = self._closing
                for item in queue:
                    self._write_item(mcap, item)
                if time.monotonic() - flushed >= _FLUSH_SECONDS:
                    mcap.flush()
                    flushed = time.monotonic()

    def _write_item(self, mcap: _Mcap, item: _Arrivals | Control | _Streams) -> None:
        if isinstance(item, Control):
            mcap.control(item)
        elif isinstance(item, _Streams):
            mcap.follow(item.streams, item.types)
        else:
            left_out = [arrival for arrival in item.arrivals if not mcap.arrival(arrival)]
            with self._changed:
                self._bytes -= item.size
                self._leave_out(left_out)


class _Mcap:
    """The file itself: a channel per stream and key, created with its first message."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._writer = Writer(self._file)
        self._writer.start("ros2", LIBRARY)  # the profile that ROS bag tools expect
        self._control = self._writer.register_channel(CONTROL_TOPIC, "json", 0)
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[tuple[str, str], int] = {}
        self._readings: dict[str, _Reading] = {}
        self._newest = self._control

    def __enter__(self) -> _Mcap:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        with self._file:
            if kind is None:
                self._writer.finish()  # type: ignore[no-untyped-call]

    def flush(self) -> None:
        """Everything written until now can be read after this call, whatever happens to the process."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def follow(self, streams: Iterable[Stream], types: RosTypes) -> None:
        """The following messages belong to these streams; a stream whose format changed goes into new channels."""
        old, self._readings = self._readings, {stream.name: _reading(stream, types) for stream in streams}
        same = {name for name, reading in self._readings.items() if old.get(name) == reading}
        self._channels = {place: channel for place, channel in self._channels.items() if place[0] in same}

    def control(self, control: Control) -> None:
        """Adds a control."""
        self._add(self._control, control.time, msgspec.json.encode(control.document))

    def arrival(self, arrival: Arrival) -> bool:
        """Adds a message; False if there are too many keys."""
        place = (arrival.stream, arrival.key)
        channel = self._channels.get(place)
        if channel is None:
            if self._newest >= _MAX_CHANNELS:
                return False
            channel = self._newest = self._channels[place] = self._open_channel(*place)
        self._add(channel, arrival.received, arrival.payload)
        return True

    def _add(self, channel: int, time: int, data: bytes) -> None:
        self._writer.add_message(channel, log_time=time, data=data, publish_time=time)

    def _open_channel(self, stream: str, key: str) -> int:
        reading = self._readings.get(stream, _Reading("", None, None))
        schema = 0
        if reading.type is not None and reading.definition is not None:
            place = reading.type, reading.definition
            schema = self._schemas.get(place) or self._writer.register_schema(
                reading.type, "ros2msg", reading.definition.encode()
            )
            self._schemas[place] = schema
        return self._writer.register_channel(key, reading.encoding, schema, {STREAM: stream})


class _Reading(NamedTuple):
    """The format of a stream's messages."""

    encoding: str
    type: str | None
    definition: str | None
    """The definition of a ROS message type, with all types that it refers to."""


def _reading(stream: Stream, types: RosTypes) -> _Reading:
    known = stream.type is not None and types.known(stream.type)
    return _Reading(stream.encoding.value, stream.type, types.definition(stream.type or "") if known else None)
