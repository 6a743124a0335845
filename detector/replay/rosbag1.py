"""ROS 1 bags, read through rosbags: each message is turned into CDR, as the ROS 2 type of the same name reads it.

A bag brings the definitions of its types. A header's `seq`, which ROS 2 has no more, is left out; beyond that a type
must hold the same fields in the same order as its ROS 2 namesake, or have none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from rosbags.interfaces import Connection
from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from detector.replay.errors import DAMAGE, RecordingError
from detector.replay.message import Message, RecordedType, Wanted, key_of

ROSBAG1_MAGIC = b"#ROSBAG V2.0\n"

_HEADER = "std_msgs/msg/Header"
_BUILTIN = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration", _HEADER)


def read_rosbag1(path: Path, wanted: Wanted) -> Iterator[Message]:
    """The bag's messages as CDR, in the order of their times.

    Raises RecordingError if it is damaged, or holds a type that ROS 2 defines otherwise.
    """
    try:
        with Reader(path) as reader:
            connections = [connection for connection in reader.connections if wanted(key_of(connection.topic))]
            if not connections:  # rosbags would read none as all
                return
            types = _types(connections)
            _compare(path, types, connections)
            _order(reader, connections)
            for connection, time, payload in reader.messages(connections):
                try:
                    cdr = bytes(types.ros1_to_cdr(payload, connection.msgtype))
                except (*DAMAGE, SerdeError) as error:
                    raise RecordingError(
                        f"{path}: a message on {connection.topic} is no {connection.msgtype} as the bag defines it: "
                        f"{error}"
                    ) from error
                yield Message(time, key_of(connection.topic), cdr, "cdr", connection.msgtype)
    except (*DAMAGE, ReaderError, TypesysError) as error:
        raise _damaged(path, error) from error


def rosbag1_types(path: Path) -> list[RecordedType]:
    """The message types that the bag defines, as ROS 2 would. Raises RecordingError if it is damaged."""
    try:
        with Reader(path) as reader:
            by_name = {connection.msgtype: connection for connection in reader.connections}
            return [RecordedType(name, _as_ros2(by_name[name]), idl=False) for name in sorted(by_name)]
    except (*DAMAGE, ReaderError) as error:
        raise _damaged(path, error) from error


def _as_ros2(connection: Connection) -> str:
    """The definition of the connection's type for ROS 2; as it is where it cannot be read: nobody may ask for it."""
    try:
        return _types([connection]).generate_msgdef(connection.msgtype, ros_version=2)[0]
    except TypesysError:
        return connection.msgdef.data


def _order(reader: Reader, connections: Sequence[Connection]) -> None:
    """Of equal times, let the place in the bag decide: rosbags would give one connection after the other."""
    entries = sorted((entry for each in connections for entry in reader.indexes[each.id]), key=tuple)
    reader.indexes.update((each.id, []) for each in connections)
    reader.indexes[connections[0].id] = entries


def _damaged(path: Path, error: Exception) -> RecordingError:
    reason = str(error) or type(error).__name__
    return RecordingError(
        f"{path}: the ROS 1 bag cannot be read, it is damaged or was not closed ({reason}): "
        f"repair it with `rosbag reindex {path}`"
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
    """Raises RecordingError where ROS 2 has a type of that name that reads otherwise."""
    known = get_typestore(Stores.ROS2_JAZZY)
    for connection in connections:
        name = connection.msgtype
        if name in known.fielddefs and _layout(types, name) != _layout(known, name):
            raise RecordingError(
                f"{path}: {connection.topic} is recorded as {name}, which has other fields in ROS 1 than in ROS 2: "
                "convert the bag with `rosbags-convert`, or take the topic out of the Detector's streams"
            )


def _layout(types: Typestore, name: str) -> list[object]:
    """What follows what in the bytes of a message; names of fields do not matter."""
    return [_piece(types, description) for _, description in types.fielddefs[name][1]]


def _piece(types: Typestore, description: FieldDesc) -> object:
    kind, detail = description
    if isinstance(detail, str):
        return _layout(types, detail)
    if isinstance(detail[0], str):
        return detail[0]
    return kind, _piece(types, detail[0]), detail[1]
