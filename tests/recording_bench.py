"""A record action without a detector: the test passes it episodes and reads its files."""

from __future__ import annotations

import json
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mcap.reader import SeekingReader
from rosbags.rosbag2 import Reader

from detector.actions.base import ActionContext, DetectorConfiguration
from detector.actions.episode import Completion, Episode, EpisodeSample, Outcome, OutcomeState
from detector.actions.record import Record
from detector.assembly import stream_readers
from tests.driving import SECOND, a_detector, a_rule, a_stream, at
from tests.ros_messages import cdr, make, pose_stamped
from wayside.api import Detector
from wayside.api.actions.record import RecordAction as Parameters

STREAMS = (
    a_stream("pose", encoding="cdr", type="geometry_msgs/msg/PoseStamped"),
    a_stream("points", encoding="raw"),
    a_stream("speed"),
    a_stream("objects", encoding="cbor"),
    a_stream("tf-static", encoding="cdr", type="tf2_msgs/msg/TFMessage", latched=True),
)


class Bench:
    """A record action of rule `r`, and its reports."""

    def __init__(self, path: Path, *streams: dict[str, Any], rule: str = "r", **parameters: Any) -> None:
        self.detector = recording_detector(path, *streams)
        self._known: DetectorConfiguration | None = None
        self.reports: list[tuple[str, Outcome]] = []
        self.lost: list[tuple[str, int, str]] = []
        context = ActionContext(
            rule=a_rule(rule, when="true"),
            action="bag",
            holder="h",
            configuration=self._configuration,
            messenger=_NoMessenger(),
            report=lambda episode, outcome: self.reports.append((episode.id, outcome)),
            lose=lambda what, count, why: self.lost.append((what, count, why)),
            closing=threading.Event(),
        )
        self.action = Record(Parameters.model_validate(parameters), context)
        self.path = path
        self._streams = streams

    def _configuration(self) -> DetectorConfiguration:
        if self._known is None or self._known.detector is not self.detector:
            self._known = configuration(self.detector)
        return self._known

    def limit(self, **recordings: Any) -> None:
        """Change the Detector's limits."""
        self.detector = recording_detector(self.path, *self._streams, **recordings)

    def record(self, episode: Episode, samples: Sequence[EpisodeSample], completion: Completion | None = None) -> Path:
        """Record a whole episode; return the folder."""
        self.action.started(episode)
        self.action.samples(episode, samples)
        self.action.ended(episode)
        self.action.completed(episode, completion or Completion())
        return self.folder(episode)

    def outcome(self, episode: Episode) -> Outcome:
        """The last report about an episode."""
        return [outcome for name, outcome in self.reports if name == episode.id][-1]

    def folder(self, episode: Episode) -> Path:
        """The folder of its only recording."""
        outcome = self.outcome(episode)
        assert outcome.state is not OutcomeState.RUNNING
        return Path(str(outcome.details["folder"]))


class _NoMessenger:
    def publish(self, key: str, payload: bytes, encoding: str) -> None:
        raise AssertionError("recordings publish nothing")

    def query(self, selector: str, payload: bytes | None, timeout: float) -> list[bytes]:
        raise AssertionError("recordings ask nobody")


def recording_detector(path: Path, *streams: dict[str, Any], **recordings: Any) -> Detector:
    return a_detector(*(streams or STREAMS), recordings={"path": str(path), "reserve": "0", **recordings})


def configuration(detector: Detector) -> DetectorConfiguration:
    readers = stream_readers(detector)
    return DetectorConfiguration(detector, readers.decoders, readers.types)


def an_episode(
    number: int = 1, *, rule: str = "r", onset: float = 1.0, clients: tuple[str, ...] = ("car1",), **fields: Any
) -> Episode:
    return Episode(
        **{
            "id": f"episode{number}",
            "rule": rule,
            "subject": "+".join(clients),
            "clients": clients,
            "element": None,
            "onset_time": at(onset),
            "start_time": at(onset),
            "values": {"speed": 3.0},
            "classification": {"typeOfAction": ["DataCollection"]},
            "rendered": {},
            "unrendered": {},
            "started": {},
            "end_time": at(onset + 1),
            "reason": "Until",
            **fields,
        }
    )


def a_sample(seconds: float, stream: str, payload: bytes, client: str = "car1") -> EpisodeSample:
    return EpisodeSample(client, stream, f"vehicles/{client}/{stream}", at(seconds), at(seconds), payload)


def pose(seconds: float, x: float = 0.0, client: str = "car1") -> EpisodeSample:
    """Stamped 5 s and 7 ns after the epoch."""
    return a_sample(seconds, "pose", cdr(pose_stamped(x)), client)


def speed(seconds: float, value: float = 0.0, client: str = "car1") -> EpisodeSample:
    return a_sample(seconds, "speed", json.dumps({"v": value}).encode(), client)


def tf_static(seconds: float, child: str = "lidar", client: str = "car1") -> EpisodeSample:
    vector = make("geometry_msgs/Vector3", x=1.0, y=0.0, z=0.0)
    rotation = make("geometry_msgs/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    stamp = make("builtin_interfaces/Time", sec=1, nanosec=0)
    transform = make(
        "geometry_msgs/TransformStamped",
        header=make("std_msgs/Header", stamp=stamp, frame_id="base"),
        child_frame_id=child,
        transform=make("geometry_msgs/Transform", translation=vector, rotation=rotation),
    )
    return a_sample(seconds, "tf-static", cdr(make("tf2_msgs/TFMessage", transforms=[transform])), client)


class Recorded(NamedTuple):
    """A message as a reader finds it; times in seconds after the start."""

    topic: str
    time: float
    payload: bytes


def as_recorded(sample: EpisodeSample) -> Recorded:
    return Recorded(f"/{sample.key}", seconds(sample.time), sample.payload)


def seconds(time: int) -> float:
    return (time - at(0)) / SECOND


def read_with_mcap(file: Path) -> list[Recorded]:
    with file.open("rb") as stream:
        return [
            Recorded(channel.topic, seconds(message.log_time), message.data)
            for _, channel, message in SeekingReader(stream, validate_crcs=True).iter_messages()
        ]


def read_with_rosbags(path: Path) -> list[Recorded]:
    """A bag or one of its files. Bags contain only ROS topics."""
    with Reader(path) as reader:
        return [Recorded(c.topic, seconds(time), bytes(payload)) for c, time, payload in reader.messages()]


def metadata_of(file: Path) -> dict[str, dict[str, str]]:
    with file.open("rb") as stream:
        return {each.name: dict(each.metadata) for each in SeekingReader(stream).iter_metadata()}


def mcap_files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.mcap"), key=lambda each: int(each.stem.rpartition("_")[2]))
