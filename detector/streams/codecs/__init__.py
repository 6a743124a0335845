"""Codecs: from the bytes of a message to plain maps, lists, strings and doubles."""

from __future__ import annotations

from detector.engine.sample import Decoder
from detector.streams.codecs.cdr import CdrDecoder
from detector.streams.codecs.etsi import DefinitionError, EtsiDecoder, OwnDefinitions
from detector.streams.codecs.json_ import JsonDecoder
from detector.streams.codecs.ros import UnknownTypeError
from wayside.api.detector import Encoding, Stream


def codec_for(stream: Stream, asn1: OwnDefinitions | None = None) -> Decoder:
    """What reads the stream's payloads; `asn1` are definitions of ETSI ITS messages that the Detector brings.

    Raises UnknownTypeError, which names the stream's field and what is close, and DefinitionError where the
    definitions of ETSI ITS messages are not there.
    """
    if stream.encoding is Encoding.UPER:
        return EtsiDecoder(stream.type, asn1)
    if stream.encoding is Encoding.JSON:
        return JsonDecoder()
    try:
        return CdrDecoder(stream.type or "")
    except UnknownTypeError as error:
        raise UnknownTypeError(stream.type or "", f"streams[{stream.name}].type") from error


__all__ = ["CdrDecoder", "DefinitionError", "EtsiDecoder", "JsonDecoder", "UnknownTypeError", "codec_for"]
