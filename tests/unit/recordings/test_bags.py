"""ROS 1 bags are read as ROS 2 messages, and recordings are played live as a source."""

import time
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from detector.assembly import stream_readers
from detector.replay.message import RecordingError, Truncation
from detector.replay.recorded_types import with_recorded_types
from detector.sources.supervision import SourceState, SourceThread
from detector.streams.codecs import CdrDecoder
from detector.streams.loss_counter import LossCounter
from tests.driving import a_detector
from tests.networks import Arrivals, stream, wait_for
from tests.patience import PATIENCE
from tests.recorded import messages_in
from wayside.api.plugin import DataSource
from wayside.api.stream import Encoding, Stream

POSE = "geometry_msgs/msg/PoseStamped"
SECOND = 10**9


@pytest.fixture
def noetic() -> Typestore:
    return get_typestore(Stores.ROS1_NOETIC)


def pose(store: Typestore, x: float, seconds: int) -> bytes:
    types = store.types
    header = types["std_msgs/msg/Header"](
        seq=77, stamp=types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=5), frame_id="map"
    )
    place = types["geometry_msgs/msg/Point"](x=x, y=2.0, z=3.0)
    turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    message = types[POSE](header=header, pose=types["geometry_msgs/msg/Pose"](position=place, orientation=turn))
    return bytes(store.serialize_ros1(message, POSE))


@pytest.fixture
def bag(tmp_path: Path, noetic: Typestore) -> Path:
    """Poses of two cars over a second, and an unused topic."""
    path = tmp_path / "drive.bag"
    with Writer(path) as writer:
        connections = [writer.add_connection(f"/vehicles/car{n}/pose", POSE, typestore=noetic) for n in (1, 2)]
        other = writer.add_connection("/other", "sensor_msgs/msg/Range", typestore=noetic)
        for number in range(10):
            writer.write(connections[number % 2], (100 + number) * SECOND // 10, pose(noetic, float(number), number))
        writer.write(other, 11 * SECOND, bytes(100))
    return path


def test_messages_of_a_ros_1_bag_are_read_as_ros_2_messages(bag: Path) -> None:
    messages = list(messages_in([bag], lambda key: key.startswith("vehicles/")))
    assert [(m.time, m.key, m.encoding, m.type) for m in messages] == [
        ((100 + n) * SECOND // 10, f"vehicles/car{n % 2 + 1}/pose", "cdr", POSE) for n in range(10)
    ]
    decoder = CdrDecoder(POSE)
    decoded = decoder.decode(messages[3].payload)
    assert decoded["header"] == {"stamp": {"sec": 3.0, "nanosec": 5.0}, "frame_id": "map"}
    assert decoded["pose"]["position"] == {"x": 3.0, "y": 2.0, "z": 3.0}
    assert decoder.stamp(messages[3].payload) == 3 * SECOND + 5


def test_messages_of_equal_times_come_in_the_order_in_which_the_bag_has_them(tmp_path: Path, noetic: Typestore) -> None:
    path = tmp_path / "grid.bag"
    cars = [1, 2, 2, 1, 2, 1, 1, 2]
    with Writer(path) as writer:
        connections = {n: writer.add_connection(f"/vehicles/car{n}/pose", POSE, typestore=noetic) for n in (1, 2)}
        for number, car in enumerate(cars):
            writer.write(connections[car], number // 4 * SECOND, pose(noetic, float(number), number))
    messages = list(messages_in([path]))
    assert [int(CdrDecoder(POSE).decode(each.payload)["pose"]["position"]["x"]) for each in messages] == [*range(8)]
    assert [each.key for each in messages] == [f"vehicles/car{car}/pose" for car in cars]


def test_custom_types_are_defined_by_the_bag(tmp_path: Path, noetic: Typestore) -> None:
    own = get_types_from_msg("string name\nfloat32[] values\nduration left", "own_msgs/msg/Thing")
    noetic.register(own)
    duration = noetic.types["builtin_interfaces/msg/Duration"](sec=4, nanosec=5)
    thing = noetic.types["own_msgs/msg/Thing"](name="a", values=np.array([1, 2], np.float32), left=duration)
    path = tmp_path / "own.bag"
    with Writer(path) as writer:
        connection = writer.add_connection("/thing", "own_msgs/msg/Thing", typestore=noetic)
        writer.write(connection, 1, noetic.serialize_ros1(thing, "own_msgs/msg/Thing"))
    (message,) = messages_in([path])
    ros2 = get_typestore(Stores.ROS2_JAZZY)
    ros2.register(own)
    read = ros2.deserialize_cdr(message.payload, "own_msgs/msg/Thing")
    assert (read.name, list(read.values), read.left.sec, read.left.nanosec) == ("a", [1, 2], 4, 5)
    things = {"name": "thing", "key": "thing", "client": "ego", "encoding": "cdr", "type": "own_msgs/msg/Thing"}
    decoder = stream_readers(with_recorded_types(a_detector(things), [path])).decoders["thing"]
    assert decoder.decode(message.payload) == {
        "name": "a",
        "values": [1.0, 2.0],
        "left": {"sec": 4.0, "nanosec": 5.0},
    }


def test_a_bag_of_common_types_does_not_change_the_detector(bag: Path) -> None:
    poses = {"name": "pose", "key": "vehicles/${client:*}/pose", "encoding": "cdr", "type": POSE}
    detector = a_detector(poses)
    assert with_recorded_types(detector, [bag]) is detector


def test_a_requested_type_with_another_ros_2_definition_is_rejected(bag: Path) -> None:
    with pytest.raises(RecordingError, match="/other is recorded as sensor_msgs/msg/Range, whose fields differ"):
        list(messages_in([bag]))


def vehicles(key: str) -> bool:
    return key.startswith("vehicles/")


@pytest.mark.parametrize("compression", [None, *Writer.CompressionFormat])
def test_a_truncated_bag_is_read_up_to_the_cut(
    tmp_path: Path, noetic: Typestore, compression: Writer.CompressionFormat | None
) -> None:
    path = tmp_path / "drive.bag"
    writer = Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    writer.chunk_threshold = 2000
    with writer:
        connection = writer.add_connection("/vehicles/car/pose", POSE, typestore=noetic)
        for number in range(100):
            writer.write(connection, number * SECOND, pose(noetic, float(number), number))
    whole, raw = list(messages_in([path])), path.read_bytes()
    assert len(whole) == 100
    counts = []
    for size in range(100, len(raw), len(raw) // 40):
        cut = tmp_path / "cut.bag"
        cut.write_bytes(raw[:size])
        reported: list[Truncation] = []
        read = list(messages_in([cut], on_cut=reported.append))
        assert read == whole[: len(read)]
        assert [(each.path, each.messages) for each in reported] == [(cut, len(read))]
        counts.append(len(read))
    assert counts == sorted(counts)
    assert len(set(counts)) > 5  # chunk by chunk, or message by message
    types = with_recorded_types(a_detector(), [cut])
    assert types.spec.messages == []


def test_a_damaged_bag_is_reported(bag: Path, tmp_path: Path) -> None:
    whole = bag.read_bytes()
    damaged = tmp_path / "damaged.bag"
    place = whole.index(b"compression=")
    damaged.write_bytes(whole[:place] + b"compressiom=" + whole[place + 12 :])
    with pytest.raises(RecordingError, match=r"damaged\.bag.*rosbag reindex"):
        list(messages_in([damaged], vehicles))
    renamed = tmp_path / "drive.ros"
    renamed.write_bytes(whole)
    with pytest.raises(RecordingError, match=r"must end in \.bag"):
        messages_in([renamed])


def playing(
    arrivals: Arrivals, loss_counter: LossCounter, *, of: Stream | None = None, **parameters: object
) -> SourceThread:
    poses = of or Stream(
        name="pose", key="vehicles/${client:*}/pose", encoding=Encoding.CDR, type=POSE, source="recording"
    )
    source = DataSource(name="recording", plugin="bag", parameters=parameters)
    thread = SourceThread(source, (poses,), arrivals.putter, loss_counter, first_pause=0.01)
    thread.start()
    return thread


def test_a_bag_is_played_at_the_wanted_speed_to_its_end(bag: Path) -> None:
    arrivals = Arrivals()
    start = time.monotonic()
    thread = playing(arrivals, LossCounter(), paths=[str(bag)], rate=5)
    wait_for(lambda: thread.state is SourceState.FINISHED)
    assert time.monotonic() - start >= 0.18
    assert [key for _, key, _ in arrivals.seen] == ["vehicles/car1/pose", "vehicles/car2/pose"] * 5


def test_a_bag_is_played_again_and_again_until_it_is_stopped(bag: Path) -> None:
    arrivals = Arrivals()
    thread = playing(arrivals, LossCounter(), paths=[str(bag)], rate=1000, loop=True)
    arrivals.wait_for(lambda seen: len(seen) > 25)
    thread.request_stop()
    thread.join(PATIENCE)
    assert thread.state is SourceState.STOPPED


def test_stopping_does_not_wait_for_a_pause_in_the_recording(tmp_path: Path) -> None:
    path = tmp_path / "slow.jsonl"
    path.write_text(
        '{"t": 1, "key": "vehicles/a/pose", "value": 1}\n{"t": 9000000000000, "key": "vehicles/a/pose", "value": 2}\n'
    )
    arrivals = Arrivals()
    thread = playing(arrivals, LossCounter(), of=stream(source="recording"), paths=[str(path)])
    arrivals.wait_for(lambda seen: len(seen) == 1)
    thread.request_stop()
    thread.join(PATIENCE)  # far less than the pause
    assert thread.state is SourceState.STOPPED


def test_a_missing_recording_is_waited_for(bag: Path, tmp_path: Path) -> None:
    arrivals, loss_counter = Arrivals(), LossCounter()
    later = tmp_path / "later.bag"
    thread = playing(arrivals, loss_counter, paths=[str(later)], rate=1000)
    wait_for(lambda: "later.bag: no such file" in thread.last_error)
    later.write_bytes(bag.read_bytes())
    wait_for(lambda: thread.state is SourceState.FINISHED)
    assert len(arrivals.seen) == 10
