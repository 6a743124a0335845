"""Converts a sample of a scenario to its document: content, sender and time.

A document's id depends only on the scenario and the sample, so repeated inserts store it once.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import bson
import numpy as np
from bson import Binary, Int64
from bson.datetime_ms import DatetimeMS
from bson.decimal128 import Decimal128

from detector.actions.database.attachments import Attachment, detach
from detector.actions.episode import EpisodeSample
from detector.engine.samples.sample import DecodeError, Decoder, NearDecoder
from wayside.api.stream import Stream

_INT64 = range(-(2**63), 2**63)
_DEPTH = 100
"""MongoDB refuses documents with deeper nesting."""


class UnfitError(ValueError):
    """A message that cannot be a document; the message of the error gives the reason."""


def bson_bytes(document: Mapping[str, Any]) -> bytes:
    """The document as BSON.

    Numbers are preserved: NaN and infinities are doubles, integers beyond 64 bits become Decimal128, or text if that
    has too few digits. Raises UnfitError if it is nested too deeply.
    """
    try:
        return bson.encode(document)
    except (bson.errors.BSONError, ValueError, OverflowError, TypeError, RecursionError):
        return bson.encode(bson_values(document))


def bson_values(document: Mapping[str, Any]) -> dict[str, Any]:
    """The document with BSON's types only. Raises UnfitError if it is nested too deeply."""
    made: dict[str, Any] = _plain(document, 0)
    return made


def _plain(value: Any, depth: int) -> Any:
    if depth > _DEPTH:
        raise UnfitError(f"the message is nested more than {_DEPTH} levels deep")
    match value:
        case np.generic():
            return _plain(value.item(), depth)  # first: numpy's doubles are Python's as well
        case None | bool() | float() | bson.Int64() | DatetimeMS() | bson.Binary():
            return value
        case int():
            return value if value in _INT64 else _wide(value)
        case str():
            return value.encode("utf-8", "replace").decode()  # lone surrogates are invalid in BSON text
        case bytes() | bytearray() | memoryview():
            return bytes(value)
        case Mapping():
            return {_name(key): _plain(each, depth + 1) for key, each in value.items()}
        case np.ndarray():
            return _plain(value.tolist(), depth)
        case list() | tuple():
            return [_plain(each, depth + 1) for each in value]
        case set() | frozenset():
            return [_plain(each, depth + 1) for each in sorted(value, key=repr)]
        case _:
            return str(value)  # values of CBOR tags: dates, fractions, UUIDs


def _wide(value: int) -> Decimal128 | str:
    return Decimal128(str(value)) if len(str(abs(value))) <= 34 else str(value)


def _name(key: Any) -> str:
    """A field's name. BSON ends names at NUL: it is replaced by its symbol."""
    text = key if isinstance(key, str) else str(key)
    return text.replace("\0", "\N{SYMBOL FOR NULL}").encode("utf-8", "replace").decode()


LARGEST = 16 * 2**20 - 2**14
"""MongoDB accepts documents of 16 MiB; a small part is reserved for what servers add."""


_RECENT = 256
"""Number of recent times of a client's stream among which equal samples are distinguished."""


@dataclass(frozen=True, slots=True)
class ConvertedDocument:
    """The result of converting a sample."""

    collection: str
    document: bytes
    """BSON."""
    files: tuple[Attachment, ...] = ()
    cut: str = ""
    """Why the message itself is not in the document; empty if it is."""
    undecoded: bool = False
    """The document contains the payload as received."""


def collection_of(stream: Stream) -> str:
    """One per message type; streams whose messages have no type have one each, e.g. json/imu."""
    return stream.type or f"{stream.encoding}/{stream.name}"


@dataclass(slots=True)
class Documents:
    """Makes the documents of one scenario."""

    scenario: str
    place: str
    """The beginning of its files' paths."""
    streams: Mapping[str, Stream]
    decoders: Mapping[str, Decoder]
    above: int | None
    """Binary fields of more bytes go to files; None: they stay in the document."""
    _near: dict[str, bool] = field(default_factory=dict)
    _recent: dict[tuple[str, str], dict[int, Counter[bytes]]] = field(default_factory=dict)
    """By client and stream, the number of equal samples at recent times."""

    def make(self, sample: EpisodeSample) -> ConvertedDocument:
        """The sample's document."""
        stream = self.streams[sample.stream]
        decoder = self.decoders[sample.stream]
        identity = self._identity(sample)
        document: dict[str, Any] = {
            "_id": Binary(identity),
            "scenario": self.scenario,
            "client": sample.client,
            "stream": sample.stream,
            "key": sample.key,
            "at": DatetimeMS(sample.time // 1_000_000),
            "time": Int64(sample.time),
            "received": Int64(sample.received),
        }
        try:
            message = decoder.decode(sample.payload)
            stamp = self._stamp(sample, decoder)
        except DecodeError as error:
            document |= {"error": str(error)[:1000], "payload": sample.payload}
            return self._fitting(stream, sample, document, identity, (), undecoded=True)
        if stamp is not None:
            document["stamp"] = Int64(stamp)
        files: list[Attachment] = []
        if self.above is not None and len(sample.payload) > self.above:
            message, files = detach(message, self.above, self._path(sample, identity))
        document["msg"] = message
        return self._fitting(stream, sample, document, identity, tuple(files), undecoded=False)

    def _stamp(self, sample: EpisodeSample, decoder: Decoder) -> int | None:
        near = self._near.get(sample.stream)
        if near is None:  # looked up once: this takes longer than everything else
            near = self._near[sample.stream] = isinstance(decoder, NearDecoder)
        if near and isinstance(decoder, NearDecoder):
            return decoder.stamp_near(sample.payload, sample.received)
        return decoder.stamp(sample.payload)

    def _fitting(
        self,
        stream: Stream,
        sample: EpisodeSample,
        document: dict[str, Any],
        identity: bytes,
        files: tuple[Attachment, ...],
        *,
        undecoded: bool,
    ) -> ConvertedDocument:
        """The document; if it is too large, one that refers to the payload or lists the omitted fields."""
        collection = collection_of(stream)
        try:
            made = bson_bytes(document)
            if len(made) <= LARGEST:
                return ConvertedDocument(collection, made, files, undecoded=undecoded)
            reason = f"the document would have {len(made)} bytes; MongoDB accepts at most {LARGEST}"
        except UnfitError as error:
            reason = str(error)
        document.pop("msg", None)
        document.pop("payload", None)
        if self.above is not None:
            whole = Attachment(f"{self._path(sample, identity)}.{stream.encoding}", sample.payload)
            document |= {"payload": whole.reference(), "note": f"the message is in a file: {reason}"}
            return ConvertedDocument(collection, bson_bytes(document), (whole,), undecoded=undecoded)
        document["cut"] = reason
        return ConvertedDocument(collection, bson_bytes(document), cut=reason, undecoded=undecoded)

    def _path(self, sample: EpisodeSample, identity: bytes) -> str:
        return f"{self.place}/{sample.stream}/{sample.client}/{sample.time}-{identity[8:14].hex()}"

    def _identity(self, sample: EpisodeSample) -> bytes:
        """20 bytes: first the time, so that documents are indexed in order of arrival, then a hash that distinguishes
        samples.

        With clock Data a client may send the same bytes twice with the same stamp: the second one gets another number.
        """
        digest = hashlib.blake2b(sample.payload, digest_size=12)
        identity = (self.scenario, sample.client, sample.stream, sample.key, str(sample.received))
        digest.update("\0".join(identity).encode())
        name = digest.digest()
        lane = (sample.client, sample.stream)
        times = self._recent.setdefault(lane, {})
        seen = times.get(sample.time)
        if seen is None:
            seen = times[sample.time] = Counter()
            if len(times) > _RECENT:
                del times[next(iter(times))]
        number = seen[name]
        seen[name] += 1
        if number:
            name = hashlib.blake2b(name + number.to_bytes(4, "big"), digest_size=12).digest()
        return sample.time.to_bytes(8, "big", signed=True) + name
