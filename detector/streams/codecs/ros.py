"""The known ROS 2 message types: those of a release, and definitions that extend or replace them."""

from __future__ import annotations

import difflib
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import cache, cached_property, lru_cache
from importlib.resources import files
from typing import Any, cast

import msgspec
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

from detector.streams.codecs.definitions import Definition, DefinitionsError, check_definitions, merged_types
from wayside.api.stream import Encoding, Stream
from wayside.rules import BYTES, Fields, ItemFields

MessageFields = list[tuple[str, FieldDesc]]
"""The fields of a message in their order."""

_FILE = "jazzy.json"
"""Written by `python -m tests.ros_definitions`."""
_FIELD = re.compile(r"(?P<name>[\w/]+)(?:<=(?P<limit>\d+))?(?:\[(?P<most><=)?(?P<count>\d*)\])?")


def release_fields() -> dict[str, MessageFields]:
    """The fields of each type of the release, in rosbags' form."""
    written = msgspec.json.decode(files(__package__).joinpath(_FILE).read_bytes(), type=dict[str, dict[str, str]])
    described: dict[str, FieldDesc] = {}
    for each in {text for fields in written.values() for text in fields.values()}:
        described[each] = _described(each)
    return {name: [(field, described[text]) for field, text in fields.items()] for name, fields in written.items()}


def _described(text: str) -> FieldDesc:
    """A field's type: `float64`, `string<=16`, `geometry_msgs/msg/Point[2]`, `uint8[]`, `uint8[<=4]`."""
    match = _FIELD.fullmatch(text)
    assert match is not None  # noqa: S101  a test compares the file with rosbags
    name, count = match["name"], match["count"]
    element: Any = (Nodetype.NAME, name) if "/" in name else (Nodetype.BASE, (name, int(match["limit"] or 0)))
    if count is None:
        return cast("FieldDesc", element)
    kind = Nodetype.ARRAY if count and not match["most"] else Nodetype.SEQUENCE
    return cast("FieldDesc", (kind, (element, int(count or 0))))


HEADER = "std_msgs/msg/Header"
TIME = "builtin_interfaces/msg/Time"

REGISTERING = threading.Lock()
"""rosbags creates the classes of new types in one shared module."""


class UnknownTypeError(ValueError):
    """An unknown ROS 2 message type; the text suggests similar ones."""

    def __init__(self, name: str, types: RosTypes, field: str | None = None) -> None:
        """`field` is the place of the name."""
        close = difflib.get_close_matches(name, types.all_fields, n=3, cutoff=0.8)
        remedy = f"did you mean {' or '.join(close)}? Otherwise give" if close else "give"
        where = f"{field}: " if field else ""
        super().__init__(f"{where}unknown message type {name!r}: {remedy} its definition in spec.messages")


class RosTypes:
    """Message types by their names, e.g. geometry_msgs/msg/PoseStamped."""

    def __init__(
        self, load: Callable[[], Typestore], fields: Callable[[], Mapping[str, MessageFields]] | None = None
    ) -> None:
        """`load` returns the types on first use: creating the classes of a release takes 0.1 s and 3 MiB.

        `fields` returns the fields of all types without the classes; None: only the types know them.
        """
        self._load = load
        self._fields = fields

    @cached_property
    def store(self) -> Typestore:
        """The types in rosbags' form."""
        return self._load()

    @cached_property
    def all_fields(self) -> Mapping[str, MessageFields]:
        """The fields by type."""
        if self._fields is not None:
            return self._fields()
        return {name: fields for name, (_, fields) in self.store.fielddefs.items()}

    def known(self, name: str) -> bool:
        """Whether the type is known."""
        return name in self.all_fields

    def fields(self, name: str) -> Sequence[tuple[str, FieldDesc]]:
        """The fields of a known type, in order."""
        return self.all_fields[name]

    def stamp_first(self, name: str) -> bool:
        """Whether the message begins with a std_msgs/msg/Header, so that its stamp is always at the same position."""
        return self._first_is(name, HEADER) and self._first_is(HEADER, TIME)

    def has_header(self, name: str) -> bool:
        """Whether the message has a field `header` with a stamp."""
        header = dict(self.fields(name)).get("header")
        return (
            header is not None
            and header[1] == HEADER
            and ("stamp", TIME) in ((field, desc[1]) for field, desc in self.fields(HEADER))
        )

    def definition(self, name: str) -> str:
        """The definition of the type and those it refers to, as in recordings (ros2msg). Raises UnknownTypeError."""
        if not self.known(name):
            raise UnknownTypeError(name, self)
        return self.store.generate_msgdef(name, ros_version=2)[0]

    def _first_is(self, name: str, type_name: str) -> bool:
        fields = self.fields(name)
        return bool(fields) and fields[0][1][1] == type_name


@cache
def standard() -> RosTypes:
    """All message types of the newest long-term ROS 2 release."""
    return RosTypes(lambda: get_typestore(Stores.ROS2_JAZZY), release_fields)


@lru_cache(maxsize=16)
def types_with(definitions: tuple[Definition, ...]) -> RosTypes:
    """The standard types and those of the definitions, which take precedence.

    Raises DefinitionsError with all problems of the definitions.
    """
    if not definitions:
        return standard()
    given = standard().store
    new = merged_types(definitions)
    check_definitions(definitions, new, given.fielddefs)
    store = Typestore()
    store.fielddefs.update({name: parts for name, parts in given.fielddefs.items() if name not in new})
    store.types.update({name: of_type for name, of_type in given.types.items() if name not in new})
    try:
        with REGISTERING:
            store.register(new)
    except (TypesysError, SyntaxError, ValueError) as error:
        raise DefinitionsError([(definitions[0].name, f"cannot use the definitions: {error}")]) from error
    return RosTypes(lambda: store)


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
