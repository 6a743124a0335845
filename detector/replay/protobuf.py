"""Protobuf messages of MCAP files, by the definitions in the files: plain values, as in JSON and CBOR.

Fields have their names in the .proto file. Numbers are numbers, including those of 64 bits; enums are the names of
their values; a field with presence is absent if it was not set, any other has its default.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mcap.exceptions import McapError
from mcap.records import Schema

from detector.replay.message import RecordingError

if TYPE_CHECKING:
    from google.protobuf.descriptor import FieldDescriptor
    from google.protobuf.message import Message

ENCODING = "protobuf"
"""MCAP's name, of messages and of schemas."""

Decode = Callable[[bytes], object]
"""Raises ValueError if the bytes are not a message of its type."""


class Decoders:
    """The decoders of one file, created on first use."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._by_schema: dict[int, Decode] = {}

    def decoder(self, schema: Schema | None, topic: str) -> Decode:
        """The decoder of the messages of a topic with this schema.

        Raises RecordingError if the file does not define them, or the package for Protobuf is not installed.
        """
        if schema is None or schema.encoding != ENCODING:
            given = "no schema" if schema is None else f"a schema in {schema.encoding or 'no encoding'}"
            raise RecordingError(
                f"{self._path}: {topic} is recorded as Protobuf with {given}: record it with its FileDescriptorSet"
            )
        if schema.id not in self._by_schema:
            self._by_schema[schema.id] = self._made(schema, topic)
        return self._by_schema[schema.id]

    def _made(self, schema: Schema, topic: str) -> Decode:
        try:
            # Not at the top: an extra, which is only needed for Protobuf.
            from google.protobuf.message import DecodeError  # noqa: PLC0415
            from mcap_protobuf.decoder import DecoderFactory  # noqa: PLC0415
        except ImportError as error:
            raise RecordingError(
                f"{self._path}: {topic} is recorded as Protobuf, which needs an extra: pip install 'wayside[protobuf]'"
            ) from error
        try:
            decode = DecoderFactory().decoder_for(ENCODING, schema)
        except (McapError, DecodeError, TypeError, KeyError) as error:
            raise RecordingError(
                f"{self._path}: cannot read the definition of {schema.name}, the type of {topic}: {error}; record "
                "it with a FileDescriptorSet that contains the type and all its imports"
            ) from error

        def plain(payload: bytes) -> object:
            try:
                return _plain(decode(payload))  # type: ignore[misc]
            except DecodeError as error:
                raise ValueError(f"no {schema.name}: {error}") from error

        return plain


def _plain(message: Message) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for field in message.DESCRIPTOR.fields:
        if field.has_presence and not message.HasField(field.name):
            continue
        value = getattr(message, field.name)
        if field.message_type is not None and field.message_type.GetOptions().map_entry:
            inner = field.message_type.fields_by_name["value"]
            values[field.name] = {str(key): _one(inner, value[key]) for key in value}
        elif field.is_repeated:
            values[field.name] = [_one(field, each) for each in value]
        else:
            values[field.name] = _one(field, value)
    return values


def _one(field: FieldDescriptor, value: Any) -> Any:
    if field.message_type is not None:
        return _plain(value)
    if field.enum_type is not None:
        known = field.enum_type.values_by_number.get(value)
        return value if known is None else known.name
    return value
