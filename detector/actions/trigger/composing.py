"""Converts plain maps to ROS 2 messages: a request in YAML becomes an object that rosbags serialises."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc
from rosbags.typesys.store import Typestore


class ServiceError(ValueError):
    """A service that is unknown or badly defined, or a request that does not match; the message gives the remedy."""


def message(store: Typestore, name: str, values: object, where: str) -> object:
    """A message of rosbags with these values; `where` is its place, for errors.

    Raises ServiceError if a value belongs to no field, or does not fit its field.
    """
    if not isinstance(values, Mapping):
        raise ServiceError(f"{where} must be a map with the fields of {name}; got {values!r:.80}")
    fields = dict(store.fielddefs[name][1])
    unknown = sorted(str(key) for key in values if key not in fields)
    if unknown:
        there = ", ".join(field for field in fields if field != "structure_needs_at_least_one_member") or "none"
        raise ServiceError(f"{where}.{unknown[0]} is not a field of {name}: its fields are {there}")
    made = [_value(store, desc, values.get(field), f"{where}.{field}") for field, desc in fields.items()]
    return store.types[name](*made)


def _value(store: Typestore, desc: FieldDesc, value: Any, where: str) -> Any:
    kind, detail = desc
    if kind is Nodetype.NAME:
        return message(store, str(detail), {} if value is None else value, where)
    if kind is Nodetype.BASE:
        return _scalar(str(detail[0]), value, where)
    element: FieldDesc = detail[0]  # type: ignore[assignment]
    count = int(detail[1]) if kind is Nodetype.ARRAY else 0
    items: Sequence[Any] = [None] * count if value is None else value
    if not isinstance(items, list | tuple) or (kind is Nodetype.ARRAY and len(items) != count):
        raise ServiceError(f"{where} must be a list{f' of {count}' if count else ''}; got {value!r:.80}")
    made = [_value(store, element, item, f"{where}[{index}]") for index, item in enumerate(items)]
    primitive = str(element[1][0]) if element[0] is Nodetype.BASE else "string"
    return made if primitive == "string" else np.array(made, dtype=_DTYPES.get(primitive, primitive))


_DTYPES = {"char": "uint8", "byte": "uint8", "bool": "bool"}
_ZEROS: Mapping[str, Any] = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}


def _scalar(kind: str, value: Any, where: str) -> Any:
    if value is None:
        return _ZEROS.get(kind, 0)
    if kind in ("string", "bool"):
        if isinstance(value, str if kind == "string" else bool):
            return value
    elif isinstance(value, int | float) and not isinstance(value, bool):
        if kind in ("float32", "float64"):
            return float(value)
        if float(value).is_integer():
            return _in_range(kind, int(value), where)
    raise ServiceError(f"{where} must be of type {kind}; got {value!r:.80}")


def _in_range(kind: str, value: int, where: str) -> int:
    bits = {"char": 8, "byte": 8}.get(kind) or int(kind.lstrip("uint"))
    signed = kind.startswith("int")
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    if not low <= value <= high:
        raise ServiceError(f"{where} must be between {low} and {high} ({kind}); got {value}")
    return value
