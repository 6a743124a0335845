"""ROS 1 bags, read through rosbags: each message is converted to CDR, to be read as the ROS 2 type of the same name.

A bag contains the definitions of its types. A header's `seq`, which ROS 2 no longer has, is left out; apart from that,
a type must have the same fields in the same order as the ROS 2 type of the same name, if there is one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

from rosbags.interfaces import Connection
from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from detector.replay.batches import Batch, batched
from detector.replay.message import (
    DAMAGE,
    Message,
    OnCut,
    Piece,
    RecordedType,
    RecordingError,
    Truncation,
    Wanted,
    messages_in_order,
    topic_key,
)
from detector.replay.rosbag1_cut import Chunk, UnindexedBag, chunk_messages, scan_bag

ROSBAG1_MAGIC = b"#ROSBAG V2.0\n"

_HEADER = "std_msgs/msg/Header"
_BUILTIN = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration", _HEADER)


def read_rosbag1(path: Path, wanted: Wanted, on_cut: OnCut) -> Iterator[Batch]:
    """The bag's messages as CDR, in time order. A bag that was not closed is read as far as possible.

    Raises RecordingError if it is damaged, or contains a type that ROS 2 defines differently.
    """
    return batched(_messages(path, wanted, on_cut))


def _messages(path: Path, wanted: Wanted, on_cut: OnCut) -> Iterator[Message]:
    try:
        cut = _contents(path)
        if cut is not None:
            yield from _read_cut(path, cut, wanted, on_cut)
            return
        with Reader(path) as reader:
            connections = [connection for connection in reader.connections if wanted(topic_key(connection.topic))]
            if not connections:  # rosbags would treat an empty list as all
                return
            convert = _converter(path, connections)
            _order(reader, connections)
            for connection, time, payload in reader.messages(connections):
                yield convert(connection, time, payload)
    except RecordingError:
        raise
    except (*DAMAGE, ReaderError, TypesysError) as error:
        raise _damaged(path, error) from error


def _read_cut(path: Path, contents: UnindexedBag, wanted: Wanted, on_cut: OnCut) -> Iterator[Message]:
    connections = {
        number: connection for number, connection in contents.connections.items() if wanted(topic_key(connection.topic))
    }
    convert = _converter(path, list(connections.values())) if connections else None

    def messages(chunk: Chunk) -> Iterator[Message]:
        for time, connection, payload in chunk_messages(path, chunk, contents):
            if convert is not None and connection in connections:
                yield convert(connections[connection], time, payload)

    count = 0
    for message in messages_in_order(Piece(chunk.start, partial(messages, chunk)) for chunk in contents.chunks):
        count += 1
        yield message
    on_cut(Truncation(path, count, contents.cut or "it has no index"))


def _contents(path: Path) -> UnindexedBag | None:
    """The contents of a bag without an index; None if it has one."""
    try:
        with Reader(path):
            return None
    except (*DAMAGE, ReaderError, TypesysError):
        return scan_bag(path, ROSBAG1_MAGIC)


def _converter(path: Path, connections: Sequence[Connection]) -> Callable[[Connection, int, bytes], Message]:
    """The conversion of these connections' messages to CDR. Raises RecordingError, TypesysError."""
    types = _types(connections)
    _compare(path, types, connections)

    def convert(connection: Connection, time: int, payload: bytes) -> Message:
        try:
            cdr = bytes(types.ros1_to_cdr(payload, connection.msgtype))
        except (*DAMAGE, SerdeError) as error:
            raise RecordingError(
                f"{path}: a message on {connection.topic} does not match {connection.msgtype} as the bag defines "
                f"it: {error}: repair the bag with `rosbag fix {path}`, or remove the topic from the Detector's "
                "streams"
            ) from error
        return Message(time, topic_key(connection.topic), cdr, "cdr", connection.msgtype)

    return convert


def rosbag1_span(path: Path) -> tuple[int, int] | None:
    """The times of the first and the last message in the bag's index; None if it has none."""
    try:
        with Reader(path) as reader:
            return (reader.start_time, reader.end_time) if reader.message_count else None
    except (*DAMAGE, ReaderError):
        return None


def rosbag1_types(path: Path) -> list[RecordedType]:
    """The message types that the bag defines, in ROS 2's form. Raises RecordingError if it is damaged."""
    try:
        cut = _contents(path)
        if cut is not None:
            return _recorded_types(cut.connections.values())
        with Reader(path) as reader:
            return _recorded_types(reader.connections)
    except (*DAMAGE, ReaderError, TypesysError) as error:
        raise _damaged(path, error) from error


def _recorded_types(connections: Iterable[Connection]) -> list[RecordedType]:
    by_name = {connection.msgtype: connection for connection in connections}
    return [RecordedType(name, _as_ros2(by_name[name]), idl=False) for name in sorted(by_name)]


def _as_ros2(connection: Connection) -> str:
    """The definition of the connection's type for ROS 2; unchanged if it cannot be read: it may not be needed."""
    try:
        return _types([connection]).generate_msgdef(connection.msgtype, ros_version=2)[0]
    except TypesysError:
        return connection.msgdef.data


def _order(reader: Reader, connections: Sequence[Connection]) -> None:
    """For equal times, use the position in the bag: rosbags would yield one connection after the other."""
    entries = sorted((entry for each in connections for entry in reader.indexes[each.id]), key=tuple)
    reader.indexes.update((each.id, []) for each in connections)
    reader.indexes[connections[0].id] = entries


def _damaged(path: Path, error: Exception) -> RecordingError:
    reason = str(error) or type(error).__name__
    return RecordingError(
        f"{path}: cannot read the ROS 1 bag: it is damaged or was not closed ({reason}): repair it with `rosbag "
        f"reindex {path}`"
    )


def _types(connections: Sequence[Connection]) -> Typestore:
    """The types as the bag defines them, with ROS 2's header and times. Raises TypesysError."""
    found: Typesdict = {}
    for connection in connections:
        found.update(get_types_from_msg(connection.msgdef.data, connection.msgtype))
    known = get_typestore(Stores.ROS2_JAZZY).fielddefs
    found.update({name: known[name] for name in _BUILTIN})
    store = get_typestore(Stores.EMPTY)
    store.register(found)
    return store


def _compare(path: Path, types: Typestore, connections: Sequence[Connection]) -> None:
    """Raises RecordingError if ROS 2 has a type of that name with another layout."""
    known = get_typestore(Stores.ROS2_JAZZY)
    for connection in connections:
        name = connection.msgtype
        if name in known.fielddefs and _layout(types, name) != _layout(known, name):
            raise RecordingError(
                f"{path}: {connection.topic} is recorded as {name}, whose fields differ between ROS 1 and ROS 2: "
                "convert the bag with `rosbags-convert`, or remove the topic from the Detector's streams"
            )


def _layout(types: Typestore, name: str) -> list[object]:
    """The sequence of values in the bytes of a message; names of fields do not matter."""
    return [_piece(types, description) for _, description in types.fielddefs[name][1]]


def _piece(types: Typestore, description: FieldDesc) -> object:
    kind, detail = description
    if isinstance(detail, str):
        return _layout(types, detail)
    if isinstance(detail[0], str):
        return detail[0]
    return kind, _piece(types, detail[0]), detail[1]
