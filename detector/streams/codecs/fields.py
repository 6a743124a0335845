"""Which fields the messages of a stream have, where that is known beforehand."""

from __future__ import annotations

from functools import cache

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc

from detector.streams.codecs.ros import known, typestore
from wayside.api.detector import Encoding, Stream
from wayside.rules import Fields


def message_fields(stream: Stream) -> Fields | None:
    """The fields of a ROS message type; None for other encodings, whose messages can have any."""
    if stream.encoding is not Encoding.CDR or stream.type is None or not known(stream.type):
        return None
    return _fields(stream.type)


@cache
def _fields(type_name: str) -> Fields:
    return {name: _below(desc) for name, desc in typestore().fielddefs[type_name][1]}


def _below(desc: FieldDesc) -> Fields | None:
    """The fields below a field; None below numbers, texts and arrays."""
    kind, detail = desc
    return _fields(str(detail)) if kind is Nodetype.NAME else None
