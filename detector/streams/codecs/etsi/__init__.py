"""ETSI ITS messages in UPER: CAM, DENM, CPM, MAPEM, SPATEM and VAM, received over the air or bare.

The path of a message: `packets` removes GeoNetworking, security and BTP; `messages` finds its kind and definition;
`reading`, built from the definition's `asn1` types, reads its `bits` into maps, with `quantities` in SI units.
"""

from __future__ import annotations

from typing import Any

from detector.engine.samples.sample import DecodeError
from detector.streams.codecs.etsi.asn1 import DefinitionError
from detector.streams.codecs.etsi.bits import Bits
from detector.streams.codecs.etsi.messages import BY_NAME, BY_NUMBER, KINDS, PREFIX, MessageKind, definitions, reader
from detector.streams.codecs.etsi.own import OwnDefinitions, own_definitions, read_module
from detector.streams.codecs.etsi.packets import message_in
from detector.streams.codecs.etsi.reading import message_members

__all__ = ["DefinitionError", "EtsiDecoder", "OwnDefinitions", "own_definitions", "read_module"]

_HEADER = 6
"""Bytes of ItsPduHeader: protocol version, message number, station. All releases agree on these."""


class EtsiDecoder:
    """Reads ITS messages of one kind, or of any."""

    def __init__(self, type_name: str | None = None, own: OwnDefinitions | None = None) -> None:
        """`type_name` is etsi/cam or similar, None for messages of all kinds; `own` are the user's definitions.

        Raises DefinitionError for an unknown kind or one without a definition.
        """
        self._only = None if type_name is None else _kind(type_name)
        kinds = (self._only,) if self._only is not None else [kind for kind in KINDS if _is_defined(kind, own)]
        found = {kind.number: definitions(kind, own) for kind in kinds}
        self._readers = {
            number: {version: reader(each) for version, each in versions.items()} for number, versions in found.items()
        }
        self.fields = None if self._only is None else message_members(dict.fromkeys(found[self._only.number].values()))
        """The fields of the messages, if they are of one kind."""

    def decode(self, payload: bytes) -> Any:
        """The message as a map: the header and the other components of its ASN.1 type. Raises DecodeError."""
        return self._read(payload)[1]

    def stamp(self, payload: bytes) -> int | None:
        """None: most messages contain a time that is only complete together with the receive time."""
        return None

    def stamp_near(self, payload: bytes, received: int) -> int | None:
        """The sender's time in nanoseconds since the epoch, if the message contains one. Raises DecodeError.

        If the message contains only a remainder of its time (generationDeltaTime recurs every 65.536 s), the time
        nearest to the receive time.
        """
        kind, message = self._read(payload)
        try:
            return kind.stamp(message, received)
        except (LookupError, TypeError):  # in the user's definitions its time is elsewhere, or absent
            return None

    def _read(self, payload: bytes) -> tuple[MessageKind, dict[str, Any]]:
        data = message_in(payload)
        if len(data) <= _HEADER:
            raise DecodeError(f"an ITS message must have more than {_HEADER} bytes; got {len(data)}")
        version, number = data[0], data[1]
        kind = BY_NUMBER.get(number)
        if kind is None or number not in self._readers:
            wanted = "" if self._only is None else f", but the stream is of {PREFIX}{self._only.name}"
            raise DecodeError(f"message {number} ({'unknown' if kind is None else PREFIX + kind.name}){wanted}")
        read = self._readers[number].get(version)
        if read is None:
            raise DecodeError(f"{PREFIX}{kind.name} has no definition for protocol version {version}")
        try:
            message = read(Bits(data))
        except DecodeError as error:
            raise DecodeError(f"not a valid {PREFIX}{kind.name} ({len(payload)} bytes): {error}") from None
        message["header"] = {
            "protocolVersion": float(version),
            "messageId": float(number),
            "stationId": float(int.from_bytes(data[2:_HEADER], "big")),
        }
        return kind, message


def _is_defined(kind: MessageKind, own: OwnDefinitions | None) -> bool:
    return bool(kind.packaged) or (own is not None and own.type(kind.types) is not None)


def _kind(type_name: str) -> MessageKind:
    kind = BY_NAME.get(type_name.removeprefix(PREFIX))
    if kind is None or not type_name.startswith(PREFIX):
        known = ", ".join(PREFIX + name for name in BY_NAME)
        raise DefinitionError(f"unknown message type {type_name!r}: the known types are {known}")
    return kind
