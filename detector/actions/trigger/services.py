"""ROS 2 services: the definitions of their requests and responses, as CDR and as plain maps.

A `.srv` file contains two message definitions separated by a line of `---`. The services of rosbag2's recorder and of
std_srvs are known without a file, in the version of the release Jazzy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.serde import SerdeError
from rosbags.typesys import get_types_from_msg
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

from detector.engine.samples.sample import DecodeError
from detector.streams.codecs.cdr import CdrDecoder
from detector.streams.codecs.definitions import message_type_of
from detector.streams.codecs.ros import REGISTERING, RosTypes

_EVENT_INFO = "service_msgs/msg/ServiceEventInfo"

_NOTHING = "---\n"
_CODE = "---\nint32 return_code\nstring error_string\n"
_SUCCESS = "---\nbool success\nstring message\n"

KNOWN: Mapping[str, str] = {
    "rosbag2_interfaces/srv/Snapshot": "---\nbool success\n",
    "rosbag2_interfaces/srv/Pause": _NOTHING,
    "rosbag2_interfaces/srv/Resume": _NOTHING,
    "rosbag2_interfaces/srv/SplitBagfile": _NOTHING,
    "rosbag2_interfaces/srv/Record": "string uri\n" + _CODE,
    "rosbag2_interfaces/srv/Stop": _CODE,
    "std_srvs/srv/Empty": _NOTHING,
    "std_srvs/srv/Trigger": _SUCCESS,
    "std_srvs/srv/SetBool": "bool data\n" + _SUCCESS,
}
"""The definitions that need not be given."""

_PARSER = (TypesysError, ValueError, TypeError, KeyError, IndexError, AssertionError, AttributeError, RecursionError)


@dataclass(frozen=True, slots=True)
class ServiceType:
    """A type of service, e.g. rosbag2_interfaces/srv/Snapshot."""

    name: str
    store: Typestore
    """Contains the service's messages and all types that they refer to."""

    @property
    def type_hash(self) -> str:
        """RIHS01_ and 64 hexadecimal digits: the hash of the whole service, defined by REP 2016."""
        return self.store.hash_rihs01(self.name)

    def request(self, values: Mapping[str, Any]) -> bytes:
        """A request as CDR with its encapsulation; fields that are not given are zero or empty.

        Raises ServiceError if a value belongs to no field, or does not fit its field.
        """
        name = f"{self.name}_Request"
        try:
            return bytes(self.store.serialize_cdr(message(self.store, name, values, "request"), name))
        except (SerdeError, OverflowError, ValueError, TypeError, AttributeError) as error:
            if isinstance(error, ServiceError):
                raise
            raise ServiceError(f"the request does not match {self.name}: {error}") from error

    def response(self, payload: bytes) -> dict[str, Any]:
        """A response as a map. Raises ServiceError if the bytes are not one."""
        try:
            decoded: dict[str, Any] = CdrDecoder(f"{self.name}_Response", RosTypes(lambda: self.store)).decode(payload)
        except DecodeError as error:
            raise ServiceError(f"the response is not of type {self.name}: {error}") from None
        return decoded


@lru_cache(maxsize=64)
def service(name: str, definition: str | None, types: RosTypes) -> ServiceType:
    """The service of that type: with the given definition, or else the known one.

    Raises ServiceError.
    """
    text = KNOWN.get(name) if definition is None else definition
    if text is None:
        raise ServiceError(f"unknown service type {name}: give its .srv file as definition")
    made = _parsed(name, text)
    store = Typestore()
    store.fielddefs.update(types.store.fielddefs)
    store.types.update(types.store.types)
    made = {key: value for key, value in made.items() if key.startswith(f"{name}_") or key not in store.fielddefs}
    for key, (_, fields) in made.items():
        for field, desc in fields:
            below = message_type_of(desc)
            if below is not None and below not in made and below not in store.fielddefs:
                raise ServiceError(f"{key}: {field} has the unknown type {below}: define it in spec.messages")
    made |= _event(name)
    try:
        with REGISTERING:
            store.fielddefs.pop(_EVENT_INFO, None)
            store.types.pop(_EVENT_INFO, None)
            store.register(made)
    except _PARSER as error:
        raise ServiceError(f"cannot use the definition of {name}: {error}") from error
    return ServiceType(name, store)


def _parsed(name: str, text: str) -> Typesdict:
    """Request and response. Raises ServiceError."""
    package, _, short = name.split("/")
    lines = text.replace("\r\n", "\n").split("\n")
    borders = [number for number, line in enumerate(lines) if line.strip() == "---"]
    if len(borders) != 1:
        raise ServiceError(
            f"the definition of {name} must have exactly one line of ---, between request and response; got "
            f"{len(borders)}"
        )
    parts = {"Request": lines[: borders[0]], "Response": lines[borders[0] + 1 :]}
    types: Typesdict = {}
    for part, its_lines in parts.items():
        try:
            parsed = get_types_from_msg("\n".join(its_lines) + "\n", f"{package}/msg/{short}_{part}")
        except _PARSER as error:
            raise ServiceError(
                f"cannot read the {part.lower()} in the definition of {name}: write a type and a name on each line, "
                f"such as float64 x ({str(error)[:120]})"
            ) from error
        for key, value in parsed.items():
            types[f"{name}_{part}" if key == f"{package}/msg/{short}_{part}" else key] = value
    return types


def _event(name: str) -> Typesdict:
    """The part of every service's type beside request and response, which its hash includes."""

    def named(of: str) -> FieldDesc:
        return Nodetype.NAME, of

    def at_most_one(of: str) -> FieldDesc:
        return Nodetype.SEQUENCE, (named(of), 1)  # type: ignore[return-value]

    request, response, event = (f"{name}_{part}" for part in ("Request", "Response", "Event"))
    octets: FieldDesc = (Nodetype.ARRAY, ((Nodetype.BASE, ("uint8", 0)), 16))
    return {
        # In ROS 2's own hashes `char` is a uint8; rosbags has a separate number for it.
        _EVENT_INFO: (
            [],
            [
                ("event_type", (Nodetype.BASE, ("uint8", 0))),
                ("stamp", named("builtin_interfaces/msg/Time")),
                ("client_gid", octets),
                ("sequence_number", (Nodetype.BASE, ("int64", 0))),
            ],
        ),
        event: (
            [],
            [("info", named(_EVENT_INFO)), ("request", at_most_one(request)), ("response", at_most_one(response))],
        ),
        name: (
            [],
            [
                ("request_message", named(request)),
                ("response_message", named(response)),
                ("event_message", named(event)),
            ],
        ),
    }


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
