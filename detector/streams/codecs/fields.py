"""The fields of a stream's messages, if they are known in advance."""

from __future__ import annotations

from functools import lru_cache
from typing import cast

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc

from detector.streams.codecs.ros import RosTypes, standard
from wayside.api.stream import Encoding, Stream
from wayside.rules import BYTES, Fields, ItemFields


def message_fields(stream: Stream, types: RosTypes | None = None) -> Fields | None:
    """The fields of a ROS message type, none for a raw message; None for other encodings, which can have any fields."""
    if stream.encoding is Encoding.RAW:
        return BYTES
    types = types or standard()
    if stream.encoding is not Encoding.CDR or stream.type is None or not types.known(stream.type):
        return None
    return _fields(types, stream.type)


@lru_cache(maxsize=4096)
def _fields(types: RosTypes, type_name: str) -> Fields:
    return {name: _below(types, desc) for name, desc in types.fields(type_name)}


def _below(types: RosTypes, desc: FieldDesc) -> Fields | None:
    """The fields below a field, or of each of its items; None below numbers, texts and arrays of these."""
    kind, detail = desc
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        inner, name = cast("FieldDesc", detail[0])
        return ItemFields(_fields(types, str(name))) if inner is Nodetype.NAME else None
    return _fields(types, str(detail)) if kind is Nodetype.NAME else None
