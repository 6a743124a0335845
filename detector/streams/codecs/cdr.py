"""CDR: ROS 2 messages, read by rosbags, then made plain by a converter that is built once per type."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import cache
from operator import attrgetter
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc
from rosbags.serde import SerdeError

from detector.engine.sample import DecodeError
from detector.streams.codecs.doubles import EXACT, number
from detector.streams.codecs.ros import UnknownTypeError, has_header, known, typestore

Convert = Callable[[Any], Any]

_STAMPS = {b"\x00\x01": struct.Struct("<iI").unpack_from, b"\x00\x00": struct.Struct(">iI").unpack_from}
"""How to read seconds and nanoseconds, by the encapsulation's representation."""
_LARGE = 4096
"""From here on, reading through a view costs less than the copy that rosbags would make behind the encapsulation."""


class CdrDecoder:
    """Reads the messages of one type, little or big endian."""

    def __init__(self, type_name: str) -> None:
        """`type_name` is a ROS 2 message type, e.g. geometry_msgs/msg/PoseStamped. Raises UnknownTypeError."""
        if not known(type_name):
            raise UnknownTypeError(type_name)
        self.type_name = type_name
        self._convert = _converter(type_name)
        self._read = typestore().deserialize_cdr
        self._stamped = has_header(type_name)

    def decode(self, payload: bytes) -> Any:
        """The message as a map; arrays of octets (uint8, char, byte) are bytes, all others lists.

        Raises DecodeError where the bytes are no message of the type. rosbags checks every length against what is
        there before it allocates, and turns what goes wrong (too short, no UTF-8, no terminator) into SerdeError.
        """
        try:
            message = self._read(payload if len(payload) < _LARGE else memoryview(payload), self.type_name)
        except SerdeError as error:
            raise DecodeError(f"no CDR of {self.type_name} ({len(payload)} bytes): {error}") from None
        return self._convert(message)

    def stamp(self, payload: bytes) -> int | None:
        """header.stamp in nanoseconds, without decoding the rest; None for a type that does not begin with a header.

        Raises DecodeError where the bytes are too short or hold no time since 1970.
        """
        if not self._stamped:
            return None
        unpack = _STAMPS.get(payload[:2])
        if unpack is None or len(payload) < 12:
            raise DecodeError(f"no CDR of {self.type_name} ({len(payload)} bytes): no header")
        seconds, nanoseconds = unpack(payload, 4)
        if seconds < 0 or nanoseconds >= 1_000_000_000:
            raise DecodeError(f"header.stamp of {self.type_name} is no time: {seconds} s, {nanoseconds} ns")
        return int(seconds) * 1_000_000_000 + int(nanoseconds)


@cache
def _converter(type_name: str) -> Convert:
    """Makes a message of the type a map."""
    definition = typestore().get_msgdef(type_name)
    fields = [
        (name, attribute, desc)
        for (name, desc), (attribute, _) in zip(typestore().fielddefs[type_name][1], definition.fields, strict=True)
        if name != "structure_needs_at_least_one_member"
    ]  # what an empty message holds on the wire
    if not fields:
        return lambda _: {}
    names = [name for name, _, _ in fields]
    conversions = [(name, convert) for name, _, desc in fields if (convert := _field(desc)) is not None]
    get = attrgetter(*(attribute for _, attribute, _ in fields))
    if len(fields) == 1:
        one, convert = names[0], _field(fields[0][2]) or (lambda value: value)
        return lambda message: {one: convert(get(message))}

    def convert_message(message: Any) -> dict[str, Any]:
        plain = dict(zip(names, get(message), strict=True))
        for name, convert in conversions:
            plain[name] = convert(plain[name])
        return plain

    return convert_message


def _field(desc: FieldDesc) -> Convert | None:
    """Makes a field's value plain; None where it already is."""
    kind, detail = desc
    if kind is Nodetype.NAME:
        return _converter(str(detail))
    if kind is Nodetype.BASE:
        return _SCALARS.get(str(detail[0]), float)
    element: FieldDesc = detail[0]  # type: ignore[assignment]
    if element[0] is Nodetype.NAME:
        convert = _converter(str(element[1]))
        return lambda values: [convert(value) for value in values]
    return _ARRAYS.get(str(element[1][0]), _small_integers)


def _octet(value: int) -> float:
    return float(value & 0xFF)  # rosbags reads a byte as signed, ROS means an octet


def _floats(values: np.ndarray[Any, Any]) -> list[float]:
    plain: list[float] = values.tolist()
    return plain


def _small_integers(values: np.ndarray[Any, Any]) -> list[float]:
    plain: list[float] = values.astype(np.float64).tolist()
    return plain


def _large_integers(values: np.ndarray[Any, Any]) -> list[float | int]:
    if values.size and (int(values.max()) > EXACT or int(values.min()) < -EXACT):
        return [number(int(value)) for value in values]
    return list(_small_integers(values))


def _octets(values: np.ndarray[Any, Any]) -> bytes:
    return values.tobytes()


_SCALARS: dict[str, Convert | None] = {
    "bool": None,
    "float32": None,
    "float64": None,
    "string": None,
    "byte": _octet,
    "int64": number,
    "uint64": number,
}
_ARRAYS: dict[str, Convert | None] = {
    "string": None,
    "bool": _floats,  # tolist() also makes numpy's booleans plain
    "float32": _floats,
    "float64": _floats,
    "uint8": _octets,
    "char": _octets,
    "byte": _octets,
    "int64": _large_integers,
    "uint64": _large_integers,
}
