"""Samples of rmw_zenoh nodes come in by their topics; their keys and numbers are checked and counted."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from rosbags.rosbag2 import Writer as BagWriter

from detector.assembly import make_engine, stream_readers
from detector.assembly.checking import findings
from detector.engine.samples.intake import Intake
from detector.findings.losses import Losses, of_streams
from detector.replay.recordings import open_recordings
from detector.replay.replaying import replay_arrivals
from detector.replay.routing import MessageRouter
from detector.streams.codecs.ros import standard
from detector.streams.loss_counter import Cause, LossCounter
from detector.streams.rmw_zenoh import MAXIMUM_PUBLISHERS, KeyMismatchError, Sequences, numbered, split
from detector.streams.zenoh import Network
from tests.driving import Drive, a_detector, a_rule, at, compiled, lines
from tests.networks import session, wait_for
from tests.ports import free_endpoint
from tests.ros_messages import cdr, odometry, pose_stamped
from wayside.api.documents import DocumentError, load_documents
from wayside.api.zenoh import Zenoh

POSE_TYPE = "geometry_msgs/msg/PoseStamped"
POSE = {
    "name": "pose",
    "key": "vehicles/${client:*}/pose",
    "layout": "RmwZenoh",
    "encoding": "cdr",
    "type": POSE_TYPE,
}
MOVED = a_rule("moved", signals=[{"name": "x", "stream": "pose", "value": "msg.pose.position.x"}], when="x > 10")


def attachment(number: int, gid: bytes, *, named: bool = False) -> zenoh.ZBytes:
    """The attachment in the format of rmw_zenoh; `named`: of its earlier versions."""
    values = {"sequence_number": zenoh.ext.Int64(number), "source_timestamp": zenoh.ext.Int64(1_767_225_600 * 10**9)}
    parts = [
        part.to_bytes()
        for name, value in values.items()
        for part in ([zenoh.ext.z_serialize(name)] if named else []) + [zenoh.ext.z_serialize(value)]
    ]
    parts += [zenoh.ext.z_serialize("source_gid").to_bytes()] if named else []
    return zenoh.ZBytes(b"".join(parts) + zenoh.ext.z_serialize(gid).to_bytes())


class Node:
    """A publisher as rmw_zenoh creates it."""

    def __init__(self, session: zenoh.Session, topic: str, *, type_name: str = POSE_TYPE, domain: int = 0) -> None:
        package, _, name = type_name.split("/")
        self._session = session
        self._key = f"{domain}/{topic}/{package}::msg::dds_::{name}_/RIHS01_{'ab' * 32}"
        self._gid = next(_GIDS).to_bytes(16, "little")
        self._number = 0

    def publish(self, payload: bytes, *, skip: int = 0, named: bool = False) -> None:
        """Publishes a message after this number of lost ones."""
        self._number += 1 + skip
        self._session.put(
            self._key,
            payload,
            attachment=attachment(self._number, self._gid, named=named),
            congestion_control=zenoh.CongestionControl.BLOCK,
        )


_GIDS = itertools.count(1)


class Receiver:
    """A network with one stream, and the intake that it fills."""

    def __init__(self, **fields: Any) -> None:
        self.intake = Intake(lambda: at(0))
        self.loss_counter = LossCounter()
        self.detector = a_detector({**POSE, **fields})
        self.endpoint = free_endpoint()
        self.network = Network(
            Zenoh(listen=[self.endpoint]),
            self.detector.spec.streams,
            self.intake.putter,
            loss_counter=self.loss_counter,
        )

    def counted(self, cause: Cause) -> int:
        return counted(self.loss_counter, cause)

    def losses(self) -> list[str]:
        losses = Losses(Drive(self.detector, MOVED).engine, self.intake)
        losses.watch(lambda: of_streams(self.loss_counter))
        return [*losses.report()]


def counted(loss_counter: LossCounter, cause: Cause) -> int:
    return sum(entry.count for entry in loss_counter.entries() if entry.cause is cause)


@pytest.fixture
def receiver(request: pytest.FixtureRequest) -> Iterator[Receiver]:
    receiver = Receiver(**getattr(request, "param", {}))
    receiver.network.start()
    yield receiver
    receiver.network.close()


@pytest.fixture
def vehicle(receiver: Receiver) -> Iterator[zenoh.Session]:
    with session(connect__endpoints=[receiver.endpoint]) as driving:
        publisher = driving.declare_publisher("7/vehicles/car1/pose/type/hash")
        wait_for(lambda: publisher.matching_status.matching)
        yield driving


def drained(receiver: Receiver, count: int) -> list[Any]:
    arrivals: list[Any] = []

    def all_there() -> bool:
        arrivals.extend(receiver.intake.drain(0))
        return len(arrivals) >= count

    wait_for(all_there)
    return arrivals


def test_samples_are_received_by_topic_and_sequence_gaps_count_as_losses(
    receiver: Receiver, vehicle: zenoh.Session
) -> None:
    one, other = Node(vehicle, "vehicles/car1/pose"), Node(vehicle, "vehicles/car2/pose", domain=7)
    for step in range(4):
        one.publish(cdr(pose_stamped(step)))
        other.publish(cdr(pose_stamped(step)), skip=step)
    arrivals = drained(receiver, 8)
    assert [arrival.key for arrival in arrivals] == ["vehicles/car1/pose", "vehicles/car2/pose"] * 4
    assert {arrival.payload for arrival in arrivals} == {cdr(pose_stamped(step)) for step in range(4)}
    wait_for(lambda: receiver.counted(Cause.MISSED) == 1 + 2 + 3)
    (line,) = [line for line in receiver.losses() if "lost before" in line]
    assert line.startswith("6 samples of stream pose lost before the detector")
    assert "vehicles/car2/pose: 7 to 9 of publisher" in line


def test_earlier_versions_and_missing_attachments_are_understood(receiver: Receiver, vehicle: zenoh.Session) -> None:
    node = Node(vehicle, "vehicles/car1/pose")
    node.publish(b"first", named=True)
    node.publish(b"second", skip=2, named=True)
    vehicle.put(f"0/vehicles/car1/pose/{POSE_TYPE.replace('/', '%')}/TypeHashNotSupported", b"third")
    vehicle.put(
        f"0/vehicles/car1/pose/{POSE_TYPE.replace('/', '%')}/TypeHashNotSupported", b"fourth", attachment=b"no such"
    )
    assert [arrival.payload for arrival in drained(receiver, 4)] == [b"first", b"second", b"third", b"fourth"]
    wait_for(lambda: receiver.counted(Cause.UNNUMBERED) == 2)
    assert receiver.counted(Cause.MISSED) == 2


def test_a_key_of_another_type_is_dropped_counted_and_reported(receiver: Receiver, vehicle: zenoh.Session) -> None:
    Node(vehicle, "vehicles/car1/pose", type_name="nav_msgs/msg/Odometry").publish(cdr(odometry()))
    vehicle.put("town/vehicles/car1/pose/on/foot", b"of another layout")
    Node(vehicle, "vehicles/car1/pose").publish(b"last")
    (arrival,) = drained(receiver, 1)
    assert arrival.payload == b"last"
    wait_for(lambda: receiver.counted(Cause.MISFIT) == 2)
    (line,) = [line for line in receiver.losses() if "do not match the stream" in line]
    assert "town/vehicles/car1/pose/on/foot is not of the form <domain>/<topic>" in line
    Node(vehicle, "vehicles/car1/pose", type_name="nav_msgs/msg/Odometry").publish(cdr(odometry()))
    wait_for(lambda: receiver.counted(Cause.MISFIT) == 3)
    (line,) = [line for line in receiver.losses() if "do not match the stream" in line]
    assert line.startswith("3 samples of stream pose dropped")
    assert f"vehicles/car1/pose is of type nav_msgs/msg/Odometry, but the type of the stream is {POSE_TYPE}" in line


@pytest.mark.parametrize("receiver", [{"domain": 7}], indirect=True)
def test_a_stream_may_be_of_one_domain(receiver: Receiver, vehicle: zenoh.Session) -> None:
    Node(vehicle, "vehicles/car1/pose", domain=0).publish(b"of another domain")
    Node(vehicle, "vehicles/car1/pose", domain=7).publish(b"of this")
    assert [arrival.payload for arrival in drained(receiver, 1)] == [b"of this"]


def test_the_same_detector_gives_the_same_events_live_and_from_a_bag_of_topics(
    receiver: Receiver, vehicle: zenoh.Session, tmp_path: Path
) -> None:
    nodes = [Node(vehicle, f"vehicles/{client}/pose") for client in ("car1", "car2")]
    for step in range(30):
        for index, node in enumerate(nodes):
            node.publish(cdr(pose_stamped((step + 3 * index) % 20)))
    arrivals = [replace(arrival, received=at(1 + number / 10)) for number, arrival in enumerate(drained(receiver, 60))]
    detector, name = receiver.detector, receiver.detector.name
    live = make_engine(detector, stream_readers(detector), holder=name, start=arrivals[0].received - 1)
    events = live.set_rules(compiled(detector, MOVED)) + live.advance(arrivals, arrivals[-1].received)
    with BagWriter(tmp_path / "bag", version=9) as bag:
        connections = {
            topic: bag.add_connection(f"/{topic}", POSE_TYPE, typestore=standard().store)
            for topic in dict.fromkeys(arrival.key for arrival in arrivals)
        }
        for arrival in arrivals:
            bag.write(connections[arrival.key], arrival.received, arrival.payload)
    router = MessageRouter(detector.spec.streams)
    replayed = replay_arrivals(router.arrivals(open_recordings([tmp_path / "bag"])), detector, [MOVED])
    assert len(events) > 3
    assert lines(replayed.events) == lines(events)


@pytest.mark.parametrize(
    ("key", "reported"),
    [
        ("0/chatter/std_msgs::msg::dds_::String_/RIHS01_df66", ("chatter", "std_msgs/msg/String")),
        ("42/a/b/c/nav_msgs::msg::dds_::Odometry_/TypeHashNotSupported", ("a/b/c", "nav_msgs/msg/Odometry")),
        ("0/chatter/std_msgs%msg%String/h", ("chatter", "std_msgs/msg/String")),
        ("0/add/example::srv::dds_::Add_Request_/h", ("add", "example/srv/Add_Request")),
    ],
)
def test_a_key_contains_topic_and_type(key: str, reported: tuple[str, str]) -> None:
    assert split(key) == reported


@pytest.mark.parametrize("key", ["", "0", "0/a/b", "x/chatter/std_msgs::msg::dds_::String_/h", "0/chatter/String/h"])
def test_an_invalid_rmw_zenoh_key_is_reported(key: str) -> None:
    with pytest.raises(KeyMismatchError):
        split(key)


@given(st.integers(-(2**63), 2**63 - 1), st.binary(min_size=16, max_size=16), st.booleans())
def test_the_number_and_the_publisher_are_read(number: int, gid: bytes, named: bool) -> None:
    assert numbered(attachment(number, gid, named=named).to_bytes()) == (gid, number)


@given(st.binary(max_size=90))
def test_other_attachments_have_no_number_or_some_number(noise: bytes) -> None:
    for raw in (noise, b"\x0fsequence_number" + noise):
        reported = numbered(raw)
        assert reported is None or (len(reported[0]) == 16 and -(2**63) <= reported[1] < 2**63)


@given(st.lists(st.integers(1, 40), min_size=1))
def test_late_samples_reduce_the_losses_in_any_order(numbers: list[int]) -> None:
    loss_counter = LossCounter()
    sequences = Sequences("s", loss_counter)
    first, *rest = [0, *dict.fromkeys(numbers)]
    for number in (first, *rest):
        sequences.follow(b"publisher", number, "t")
    assert counted(loss_counter, Cause.MISSED) - counted(loss_counter, Cause.OVERTAKEN) == max(rest) + 1 - (
        len(rest) + 1
    )


def test_restarts_and_duplicates_do_not_count_as_losses() -> None:
    loss_counter = LossCounter()
    sequences = Sequences("s", loss_counter)
    for number in (5_000, 5_001, 5_001, 1, 2, 2**62, 3):
        sequences.follow(b"publisher", number, "t")
    assert loss_counter.entries() == []


def test_the_memory_for_made_up_publishers_is_bounded() -> None:
    sequences = Sequences("s", LossCounter())
    for number in range(MAXIMUM_PUBLISHERS + 10):
        sequences.follow(number.to_bytes(16, "little"), 1, "t")
    assert len(sequences._last) == MAXIMUM_PUBLISHERS


DETECTOR = """\
apiVersion: wayside.dev/v1alpha1
kind: Detector
metadata: {name: d}
spec:
  streams:
    - name: pose
      key: vehicles/${client:*}/pose
      layout: RmwZenoh
      encoding: json
    - {name: speed, key: "vehicles/${client:*}/speed", encoding: json, domain: 3}
"""


def test_conflicting_settings_are_reported_by_field(tmp_path: Path) -> None:
    (tmp_path / "detector.yaml").write_text(DETECTOR)
    with pytest.raises(DocumentError) as caught:
        findings(load_documents([tmp_path / "detector.yaml"]))
    first, second = caught.value.problems
    assert (first.line, first.field) == (6, "spec.streams[0]")
    assert "encoding must be cdr or raw; got json" in first.message
    assert (second.line, second.field) == (10, "spec.streams[1]")
    assert "domain is valid only with layout RmwZenoh" in second.message
