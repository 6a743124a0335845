"""CDR: ROS 2 messages, read by rosbags, then converted to plain values by a function that is built once per type."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import cached_property, lru_cache
from operator import attrgetter
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc
from rosbags.serde import SerdeError

from detector.engine.samples.sample import DecodeError, FieldReader
from detector.streams.codecs.cdr_fields import cdr_fields
from detector.streams.codecs.cdr_values import PADDING, Convert, array, scalar
from detector.streams.codecs.paths import Path
from detector.streams.codecs.ros import RosTypes, UnknownTypeError, standard

_STAMPS = {b"\x00\x01": struct.Struct("<iI").unpack_from, b"\x00\x00": struct.Struct(">iI").unpack_from}
"""Reads seconds and nanoseconds, by the encapsulation's representation."""
_LARGE = 4096
"""From this size, reading through a view costs less than the copy that rosbags would make after the encapsulation."""


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
        self._types = types
        self._stamp_first = types.stamp_first(type_name)
        self._has_header = types.has_header(type_name)

    @cached_property
    def _convert(self) -> Convert:
        return _converter(self._types, self.type_name)

    def decode(self, payload: bytes) -> Any:
        """The message as a map; arrays of octets (uint8, char, byte) are bytes, all others lists.

        Raises DecodeError if the bytes are not a message of the type. rosbags checks every length against the available
        bytes before it allocates, and raises SerdeError for errors (too short, no UTF-8, no terminator).
        """
        try:
            message = self._types.store.deserialize_cdr(
                payload if len(payload) < _LARGE else memoryview(payload), self.type_name
            )
        except SerdeError as error:
            raise DecodeError(f"not CDR of {self.type_name} ({len(payload)} bytes): {error}") from None
        return self._convert(message)

    def stamp(self, payload: bytes) -> int | None:
        """header.stamp in nanoseconds, without decoding the rest if it comes first; None for a type without header.

        Raises DecodeError if the bytes are too short or contain no time since 1970.
        """
        if not self._stamp_first:
            return self._stamp_inside(payload) if self._has_header else None
        unpack = _STAMPS.get(payload[:2])
        if unpack is None or len(payload) < 12:
            raise DecodeError(f"not CDR of {self.type_name} ({len(payload)} bytes): no header")
        return self._time(*unpack(payload, 4))

    def field_reader(self, paths: Sequence[Path]) -> FieldReader | None:
        """A reader of only these paths; None for types with wide texts, empty arrays or an unusual size."""
        reader = cdr_fields(self._types, self.type_name, paths, self.decode)
        if reader is None:
            _ = self._convert  # made now and not with the first message
        return reader

    def _stamp_inside(self, payload: bytes) -> int:
        """header.stamp if other fields precede the header."""
        stamp = self.decode(payload)["header"]["stamp"]
        return self._time(int(stamp["sec"]), int(stamp["nanosec"]))

    def _time(self, seconds: int, nanoseconds: int) -> int:
        if seconds < 0 or nanoseconds >= 1_000_000_000:
            raise DecodeError(f"header.stamp of {self.type_name} is not a time: {seconds} s, {nanoseconds} ns")
        return seconds * 1_000_000_000 + nanoseconds


@lru_cache(maxsize=4096)
def _converter(types: RosTypes, type_name: str) -> Convert:
    """The conversion of a message of the type to a map."""
    definition = types.store.get_msgdef(type_name)
    fields = [
        (name, attribute, desc)
        for (name, desc), (attribute, _) in zip(types.fields(type_name), definition.fields, strict=True)
        if name != PADDING
    ]
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
    """The conversion of a field's value to a plain one; None if it is plain already."""
    kind, detail = desc
    if kind is Nodetype.NAME:
        return _converter(types, str(detail))
    if kind is Nodetype.BASE:
        return scalar(str(detail[0]))
    element: FieldDesc = detail[0]  # type: ignore[assignment]
    if element[0] is Nodetype.NAME:
        convert = _converter(types, str(element[1]))
        return lambda values: [convert(value) for value in values]
    return array(str(element[1][0]))
