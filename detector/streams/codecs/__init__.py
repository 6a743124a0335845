"""Codecs: from the bytes of a message to plain maps, lists, strings and doubles."""

from __future__ import annotations

from detector.engine.samples.sample import Decoder
from detector.streams.codecs.cbor import CborDecoder
from detector.streams.codecs.cdr import CdrDecoder
from detector.streams.codecs.etsi import DefinitionError, EtsiDecoder, OwnDefinitions
from detector.streams.codecs.json_ import JsonDecoder
from detector.streams.codecs.ros import RosTypes, UnknownTypeError, standard
from wayside.api.stream import Encoding, Stream


class RawDecoder:
    """Returns the payload itself; expressions can read its size (`sample.size`), and pass the bytes to functions."""

    def decode(self, payload: bytes) -> bytes:
        """The payload."""
        return payload

    def stamp(self, payload: bytes) -> int | None:
        """None: the meaning of the bytes is unknown."""
        return None


def codec_for(stream: Stream, *, types: RosTypes | None = None, asn1: OwnDefinitions | None = None) -> Decoder:
    """The decoder of the stream's payloads.

    `types` are the known ROS 2 message types, by default the standard ones; `asn1` are the Detector's definitions of
    ETSI ITS messages. Raises UnknownTypeError, which names the stream's field and similar types, and DefinitionError if
    the definitions of ETSI ITS messages are missing.
    """
    match stream.encoding:
        case Encoding.JSON:
            return JsonDecoder()
        case Encoding.CBOR:
            return CborDecoder()
        case Encoding.RAW:
            return RawDecoder()
        case Encoding.UPER:
            return EtsiDecoder(stream.type, asn1)
        case Encoding.CDR:
            types = types or standard()
            if not types.known(stream.type or ""):
                raise UnknownTypeError(stream.type or "", types, f"streams[{stream.name}].type")
            return CdrDecoder(stream.type or "", types)


__all__ = [
    "CborDecoder",
    "CdrDecoder",
    "DefinitionError",
    "EtsiDecoder",
    "JsonDecoder",
    "RawDecoder",
    "UnknownTypeError",
    "codec_for",
]
