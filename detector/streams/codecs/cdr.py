"""CDR: ROS 2 messages, read by rosbags, then made plain by a converter that is built once per type."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from operator import attrgetter
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc
from rosbags.serde import SerdeError

from detector.engine.samples.sample import DecodeError
from detector.streams.codecs.doubles import EXACT, number
from detector.streams.codecs.ros import RosTypes, UnknownTypeError, standard

Convert = Callable[[Any], Any]

_STAMPS = {b"\x00\x01": struct.Struct("<iI").unpack_from, b"\x00\x00": struct.Struct(">iI").unpack_from}
"""How to read seconds and nanoseconds, by the encapsulation's representation."""
_LARGE = 4096
"""From here on, reading through a view costs less than the copy that rosbags would make behind the encapsulation."""


class CdrDecoder:
    """Reads the messages of one type, little or big endian."""

    def __init__(self, type_name: str, types: RosTypes | None = None) -> None:
        """`type_name` is one of the types, e.g. geometry_msgs/msg/PoseStamped; without `types`, a standard one.

        Raises UnknownTypeError.
        """
        types = types or standard()
        if not types.known(type_name):
            raise UnknownTypeError(type_name, types)
        self.type_name = type_name
        self._convert = _converter(types, type_name)
        self._read = types.store.deserialize_cdr
        self._stamp_first = types.stamp_first(type_name)
        self._has_header = types.has_header(type_name)

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
        """header.stamp in nanoseconds, without decoding the rest where it comes first; None for a type without header.

        Raises DecodeError where the bytes are too short or hold no time since 1970.
        """
        if not self._stamp_first:
            return self._stamp_inside(payload) if self._has_header else None
        unpack = _STAMPS.get(payload[:2])
        if unpack is None or len(payload) < 12:
            raise DecodeError(f"no CDR of {self.type_name} ({len(payload)} bytes): no header")
        return self._time(*unpack(payload, 4))

    def _stamp_inside(self, payload: bytes) -> int:
        """header.stamp where other fields come before the header."""
        stamp = self.decode(payload)["header"]["stamp"]
        return self._time(int(stamp["sec"]), int(stamp["nanosec"]))

    def _time(self, seconds: int, nanoseconds: int) -> int:
        if seconds < 0 or nanoseconds >= 1_000_000_000:
            raise DecodeError(f"header.stamp of {self.type_name} is no time: {seconds} s, {nanoseconds} ns")
        return seconds * 1_000_000_000 + nanoseconds


@lru_cache(maxsize=4096)
def _converter(types: RosTypes, type_name: str) -> Convert:
    """Makes a message of the type a map."""
    definition = types.store.get_msgdef(type_name)
    fields = [
        (name, attribute, desc)
        for (name, desc), (attribute, _) in zip(types.fields(type_name), definition.fields, strict=True)
        if name != "structure_needs_at_least_one_member"
    ]  # what an empty message holds on the wire
    if not fields:
        return lambda _: {}
    names = [name for name, _, _ in fields]
    conversions = [(name, convert) for name, _, desc in fields if (convert := _field(types, desc)) is not None]
    get = attrgetter(*(attribute for _, attribute, _ in fields))
    if len(fields) == 1:
        one, convert = names[0], _field(types, fields[0][2]) or (lambda value: value)
        return lambda message: {one: convert(get(message))}

    def convert_message(message: Any) -> dict[str, Any]:
        plain = dict(zip(names, get(message), strict=True))
        for name, convert in conversions:
            plain[name] = convert(plain[name])
        return plain

    return convert_message


def _field(types: RosTypes, desc: FieldDesc) -> Convert | None:
    """Makes a field's value plain; None where it already is."""
    kind, detail = desc
    if kind is Nodetype.NAME:
        return _converter(types, str(detail))
    if kind is Nodetype.BASE:
        return _SCALARS.get(str(detail[0]), float)
    element: FieldDesc = detail[0]  # type: ignore[assignment]
    if element[0] is Nodetype.NAME:
        convert = _converter(types, str(element[1]))
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
