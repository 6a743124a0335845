"""The recording of one episode: its samples, in one file or in several, each of which can be read alone.

On an error (no room, a disk failure) the recording ends: its written part is completed, marked as cut and kept. If even
that fails, its hidden folder stays, and the next start of the detector tries again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, NamedTuple

from detector.actions.base import DetectorConfiguration
from detector.actions.episode import EpisodeSample
from detector.actions.record.channels import ChannelFormat, FileChannels, Owners, Place, channel_format
from detector.actions.record.description import (
    METADATA,
    METADATA_CUT,
    METADATA_END,
    METADATA_USER,
    BagFile,
    as_text,
    beginning,
    ending,
    with_ending,
)
from detector.actions.record.destination import FinishedRecording, NoRoomError
from detector.actions.record.folder import RecordingFolder
from detector.actions.record.mcap_file import McapFile, SyncError, compressor
from detector.engine.buffering.lanes import latched_topics
from detector.engine.samples.sample import DecodeError, NearDecoder
from wayside.api.actions.record import RecordAction
from wayside.api.detector import Clock
from wayside.expressions import EvaluationError
from wayside.rules import compile_stream


class _Latched(NamedTuple):
    """The last samples of a latched stream: each further file begins with them."""

    sample: EpisodeSample
    number: int


class Recording:
    """Receives the samples of an episode's window, from one thread."""

    def __init__(
        self,
        folder: RecordingFolder,
        description: Mapping[str, Any],
        parameters: RecordAction,
        configuration: DetectorConfiguration,
        *,
        start: int | None,
    ) -> None:
        """`description` describes the recording; `start` is the start of the window in nanoseconds, if known.

        Raises NoRoomError, OSError: then nothing of it remains.
        """
        self._folder = folder
        self._description = description
        self._parameters = parameters
        self._start = start
        self._parts: list[BagFile] = []
        self._latched: dict[tuple[str, Hashable], _Latched] = {}
        self._numbers: Counter[Place] = Counter()
        self._held: list[EpisodeSample] = []
        self._readings: dict[str, ChannelFormat] = {}
        self._first: int | None = None  # the earliest time in the file, except for latched streams
        self._file: McapFile | None = None
        self._began: int | None = None
        self._closed_bytes = self._taken = self._lost = 0
        self.given = 0
        """Samples that it received, each message counted once."""
        self.follow(configuration)
        try:
            folder.describe(description)
            self._open()
        except BaseException:
            self._give_up()
            folder.remove()
            raise

    def follow(self, configuration: DetectorConfiguration) -> None:
        """Use this Detector from now on: a stream whose format changed continues in another channel."""
        spec, wanted = configuration.detector.spec, self._parameters.streams
        streams = {s.name: s for s in spec.streams if wanted is None or s.latched or s.name in wanted}
        self._configuration = configuration
        self._stamps = Stamps(configuration)
        self._owners = Owners(streams)
        self._topics = latched_topics(configuration.detector, configuration.decoders)
        old, self._readings = self._readings, {}
        for name, stream in streams.items():
            self._readings[name] = channel_format(stream, configuration.types)
        if self._file is not None:
            self._channels.retain({name for name, each in self._readings.items() if old.get(name) == each})

    def add(self, samples: Sequence[EpisodeSample], configuration: DetectorConfiguration) -> None:
        """Add samples. Raises NoRoomError, OSError: then it accepts no more, and `finish` keeps the written samples."""
        if configuration.detector is not self._configuration.detector:
            self.follow(configuration)
        mine = [sample for sample in samples if self._owners.owns(sample.stream, sample.key)]
        self.given += len(mine)
        for sample in mine:
            if self._start is None:
                if sample.stream in self._topics:
                    self._held.append(sample)  # the window begins with the first sample of another stream
                    continue
                self._start = sample.time
                self._release()
            self._add_sample(sample)

    def began_with(self, samples: Sequence[EpisodeSample]) -> int | None:
        """The start of the recording if these samples follow, latched ones aside; nanoseconds. None: not known yet."""
        if self._began is None:
            return min((sample.time for sample in samples if sample.stream not in self._topics), default=None)
        return self._began

    @property
    def latched(self) -> list[EpisodeSample]:
        """The last samples of latched streams, in time order."""
        known = sorted(self._latched.values(), key=lambda each: each.sample.time)
        return [*(each.sample for each in known), *self._held]

    def flush(self) -> None:
        """Passes queued samples to the kernel, so that they survive the process. Raises NoRoomError, OSError."""
        if self._file is not None:
            self._file.flush()

    @property
    def bytes(self) -> int:
        """Bytes written until now."""
        return self._closed_bytes + (0 if self._file is None else self._file.end)

    @property
    def written(self) -> int:
        """Number of samples in the files, each counted once."""
        return self._taken - self._lost - (0 if self._file is None else self._file.lost)

    @property
    def waiting(self) -> bool:
        """Whether there are samples to flush."""
        return self._file is not None and self._file.waiting > 0

    def finish(
        self, description: Mapping[str, Any], cut: str, missing: int
    ) -> tuple[FinishedRecording | None, dict[str, Any]]:
        """Completes the recording under its final name; also returns its last description.

        Args:
            description: the description after the end of the episode.
            cut: why part of the window is missing; empty if nothing is.
            missing: samples of the window that never arrived here.

        Returns None for a cut recording without contents worth keeping. Raises OSError if it could not be completed,
        and leaves it for the next start of the detector.
        """
        try:
            self._release()
            self.flush()
        except (NoRoomError, OSError) as error:
            cut = cut or reason(error)
        try:
            self._folder.use_room()
            while self._file is not None:
                cut = self._complete(self._file, description, cut, missing)
            description = self._ending(description, cut, missing)
            if "cut" in description and not self.written:
                self._folder.remove()
                return None, description
            return self._folder.publish(self._parts, description), description
        except OSError:
            self._give_up()
            self._folder.leave()
            raise

    def _complete(self, file: McapFile, description: Mapping[str, Any], cut: str, missing: int) -> str:
        """Tries to complete the last file, or makes room for the next try; returns the reason why the recording is
        cut, if any.
        """
        description = self._ending(description, cut, missing)
        try:
            if "cut" in description:
                file.add_metadata(METADATA_CUT, {"reason": description["cut"]})
            file.add_metadata(METADATA_END, ending(description))
            file.finish()
        except SyncError:
            raise
        except (NoRoomError, OSError) as error:
            if not file.drop_last_chunk():  # nothing remains of it
                self._close(file)
                self._parts.pop()
                file.path.unlink()
            return cut or reason(error)
        self._close(file)
        return cut

    def _close(self, file: McapFile) -> None:
        file.give_up()
        self._file = None
        self._parts.append(BagFile(file.path.name, file.contents))
        self._closed_bytes += file.end
        self._lost += file.lost

    def _give_up(self) -> None:
        if self._file is not None:
            self._file.give_up()

    def _ending(self, description: Mapping[str, Any], cut: str, missing: int) -> dict[str, Any]:
        missing += self.given - self.written
        if missing and not cut:
            cut = f"{missing} samples of the window are missing"
        names = [part.name for part in self._parts] + ([] if self._file is None else [self._file.path.name])
        return with_ending(description, samples=self.written, missing=missing or None, cut=cut or None, files=names)

    def _release(self) -> None:
        """Write the last samples of latched streams before the window at its start."""
        held, self._held = self._held, []
        for sample in held:
            self._add_sample(sample)

    def _add_sample(self, sample: EpisodeSample) -> None:
        place = sample.stream, sample.key, sample.client
        log_time = sample.time
        latched = sample.stream in self._topics
        if latched:
            log_time = log_time if self._start is None else max(log_time, self._start)
        else:
            self._split(log_time, len(sample.payload))
            self._first = log_time if self._first is None else min(self._first, log_time)
            self._began = log_time if self._began is None else self._began
        channel = self._channel(place)
        if channel is None:
            return
        self._numbers[place] += 1
        number = self._numbers[place]
        if latched:
            about = sample.stream, self._topics[sample.stream](sample.key, sample.payload)
            known = self._latched.get(about)
            if known is None or known.sample.time <= sample.time:
                self._latched[about] = _Latched(sample, number)
        self._taken += 1
        self._add(channel, number, log_time, sample)

    def _add(self, channel: int, number: int, log_time: int, sample: EpisodeSample) -> None:
        publish_time = self._stamps.publish_time(sample)
        self._writer.add(channel, number & 0xFFFFFFFF, log_time, publish_time, sample.payload)

    @property
    def _writer(self) -> McapFile:
        if self._file is None:
            raise OSError("the recording has ended")
        return self._file

    def _split(self, time: int, size: int) -> None:
        """Starts another file when it is due, beginning with the last samples of latched streams."""
        split, first, file = self._parameters.split, self._first, self._writer
        if first is None:
            return
        too_large = split.bytes is not None and file.size + size > split.bytes.bytes
        too_long = split.duration is not None and time - first >= split.duration.ns
        if not (too_large or too_long):
            return
        file.finish()
        self._close(file)
        self._open()
        for latched in sorted(self._latched.values(), key=lambda each: each.sample.time):
            sample = latched.sample
            channel = self._channel((sample.stream, sample.key, sample.client))
            if channel is not None:
                self._add(channel, latched.number, time, sample)

    def _open(self) -> None:
        ros = any(each.type is not None for each in self._readings.values())
        name = f"{self._folder.name}_{len(self._parts)}.mcap"
        self._folder.claim(0, 0, 1)
        self._file = McapFile.create(
            self._folder.path / name,
            "ros2" if ros else "",
            compressor(self._parameters.compression),
            self._folder.claim,
        )
        self._channels, self._first = FileChannels(self._file), None
        self._file.add_metadata(METADATA, {**beginning(self._description), "file": str(len(self._parts))})
        if self._description.get("metadata"):
            self._file.add_metadata(METADATA_USER, as_text(self._description["metadata"]))

    def _channel(self, place: Place) -> int | None:
        return self._channels.number(place, self._readings.get(place[0]))


def reason(error: Exception) -> str:
    """Why a recording ended, for users."""
    return str(error) if isinstance(error, NoRoomError) else f"writing failed: {error}"


_Stamp = Callable[[EpisodeSample], int | None]
_LATEST = 2**63 - 1


class Stamps:
    """Reads the stamps of messages, as defined by the Detector for each stream."""

    def __init__(self, configuration: DetectorConfiguration) -> None:
        self._configuration = configuration
        self._data = configuration.detector.spec.clock is Clock.DATA
        self._stamps: dict[str, _Stamp] = {}

    def publish_time(self, sample: EpisodeSample) -> int:
        """Nanoseconds since the epoch: the message's stamp, or its receive time if it has none."""
        if self._data:
            return sample.time  # which is the stamp
        read = self._stamps.get(sample.stream)
        if read is None:
            read = self._stamps[sample.stream] = self._reader(sample.stream)
        try:
            stamp = read(sample)
        except (DecodeError, EvaluationError, ValueError):
            stamp = None
        return sample.received if stamp is None or not 0 <= stamp <= _LATEST else stamp

    def _reader(self, name: str) -> _Stamp:
        stream, decoder = self._configuration.detector.spec.stream(name), self._configuration.decoders.get(name)
        if stream is None or decoder is None:
            return lambda sample: None
        expression = compile_stream(stream, 0).stamp
        if expression is not None:
            return lambda sample: _nanoseconds(expression.evaluate({"msg": decoder.decode(sample.payload)}))
        if isinstance(decoder, NearDecoder):
            near = decoder
            return lambda sample: near.stamp_near(sample.payload, sample.received)
        return lambda sample: decoder.stamp(sample.payload)


def _nanoseconds(seconds: object) -> int | None:
    """To the microsecond: a double has no greater precision for a time since the epoch."""
    if not isinstance(seconds, int | float) or not 0 <= seconds < 1e11:
        return None
    return round(seconds * 1e6) * 1000
