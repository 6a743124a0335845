"""CDR: converts the numbers, texts and arrays of ROS 2 messages to plain values."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from wayside.expressions.numbers import MAX_EXACT, as_double

Convert = Callable[[Any], Any]

PADDING = "structure_needs_at_least_one_member"
"""The content of an empty message on the wire; not one of its fields."""


def scalar(kind: str) -> Convert | None:
    """The conversion of a value of this ROS type to a plain one; None if it is plain already."""
    return _SCALARS.get(kind, float)


def array(kind: str) -> Convert | None:
    """The conversion of a numpy array of this ROS type to a plain value; None if it is plain already."""
    return _ARRAYS.get(kind, _small_integers)


def _octet(value: int) -> float:
    return float(value & 0xFF)  # rosbags reads a byte as signed; in ROS it is an octet


def _floats(values: np.ndarray[Any, Any]) -> list[float]:
    plain: list[float] = values.tolist()
    return plain


def _small_integers(values: np.ndarray[Any, Any]) -> list[float]:
    plain: list[float] = values.astype(np.float64).tolist()
    return plain


def _large_integers(values: np.ndarray[Any, Any]) -> list[float | int]:
    if values.size and (int(values.max()) > MAX_EXACT or int(values.min()) < -MAX_EXACT):
        return [as_double(int(value)) for value in values]
    return list(_small_integers(values))


def _octets(values: np.ndarray[Any, Any]) -> bytes:
    return values.tobytes()


_SCALARS: dict[str, Convert | None] = {
    "bool": None,
    "float32": None,
    "float64": None,
    "string": None,
    "byte": _octet,
    "int64": as_double,
    "uint64": as_double,
}
_ARRAYS: dict[str, Convert | None] = {
    "string": None,
    "bool": _floats,  # tolist() also converts numpy's booleans
    "float32": _floats,
    "float64": _floats,
    "uint8": _octets,
    "char": _octets,
    "byte": _octets,
    "int64": _large_integers,
    "uint64": _large_integers,
}
