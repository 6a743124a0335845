"""Messages of any ROS 2 type with random content, and random paths into them."""

from __future__ import annotations

import struct
from random import Random
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc
from rosbags.serde.utils import ndtype

from detector.streams.codecs.ros import RosTypes
from tests.unit.encodings.whole_messages import Path

TEXTS = ("", "a", "map", "odom_x", "größe", "vehicles/car-12/base")
INTEGERS = {f"{sign}int{bits}": (sign, bits) for sign in ("", "u") for bits in (8, 16, 32, 64)} | {
    "byte": ("", 8),
    "char": ("u", 8),
}


def random_message(types: RosTypes, type_name: str, random: Random) -> Any:
    """An object of the type; its sequences have at most three elements."""
    values = [_value(types, desc, random) for _, desc in types.fields(type_name)]
    return types.store.types[type_name](*values)


def serialized(types: RosTypes, message: Any, little_endian: bool) -> bytes:
    return bytes(types.store.serialize_cdr(message, message.__msgtype__, little_endian=little_endian))


def random_paths(types: RosTypes, type_name: str, random: Random) -> list[Path]:
    """At most four; some lead to nothing, or through what has no members."""
    return [_path(types, type_name, random) for _ in range(random.randrange(1, 5))]


def _path(types: RosTypes, type_name: str, random: Random) -> Path:
    name, (kind, detail) = random.choice(types.fields(type_name))
    if random.random() < 0.03:
        return ("nowhere", "x") if random.random() < 0.5 else (0, "x")
    if kind is Nodetype.NAME:
        return (name, *_path(types, str(detail), random)) if random.random() < 0.9 else (name,)
    below = random.random()
    if kind is Nodetype.BASE or below < 0.6:
        return (name, "x") if below > 0.97 else (name,)
    element: FieldDesc = detail[0]  # type: ignore[assignment]
    deeper = _path(types, str(element[1]), random) if element[0] is Nodetype.NAME else ()
    return (name, random.randrange(3), *deeper) if below < 0.97 else (name, "x")


def _value(types: RosTypes, desc: FieldDesc, random: Random) -> Any:
    kind, detail = desc
    if kind is Nodetype.NAME:
        return random_message(types, str(detail), random)
    if kind is Nodetype.BASE:
        return _scalar(str(detail[0]), random)
    element: FieldDesc = detail[0]  # type: ignore[assignment]
    count = int(detail[1]) if kind is Nodetype.ARRAY else random.randrange(4)
    if element[0] is Nodetype.BASE and element[1][0] != "string":
        numbers = [_scalar(str(element[1][0]), random) for _ in range(min(count, 40))]
        numbers = (numbers * (count // max(1, len(numbers)) + 1))[:count]
        return np.array(numbers, np.dtype(getattr(np, ndtype(str(element[1][0])))))
    return [_value(types, element, random) for _ in range(count)]


def _scalar(kind: str, random: Random) -> Any:
    if kind == "string":
        return random.choice(TEXTS)
    if kind == "bool":
        return random.random() < 0.5
    if kind == "float64":
        return random.choice((0.0, -0.0, float("nan"), float("inf"), random.uniform(-1e9, 1e9)))
    if kind == "float32":
        return struct.unpack("<f", struct.pack("<f", random.uniform(-1e3, 1e3)))[0]
    sign, bits = INTEGERS[kind]
    low = 0 if sign else -(2 ** (bits - 1))
    return random.choice((low, low + 2**bits - 1, random.randint(low, low + 2**bits - 1), 1))
