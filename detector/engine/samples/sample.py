"""The input of the engine: samples, and how their payloads are read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import msgspec
import numpy as np
from numpy.typing import NDArray

from wayside.expressions.columns.values import MISSING

__all__ = ["MISSING"]

SAMPLE_OVERHEAD = 160
"""The memory of a sample without its payload, in bytes: its object, its numbers and its entries in queues."""


class Arrival(msgspec.Struct, frozen=True, gc=False, order=True):
    """One message as the intake queued it, before the engine reads it."""

    received: int
    """When the intake received it, in nanoseconds since the epoch. It never goes back; the order distinguishes equal
    times."""
    stream: str
    """The stream in the Detector."""
    key: str
    """The full Zenoh key (or topic without its leading slash)."""
    payload: bytes
    """The message as received, undecoded."""

    @property
    def time(self) -> int:
        """Its time on the engine's time axis, with clock Wall; nanoseconds."""
        return self.received


class StampedSample(msgspec.Struct, frozen=True, gc=False, order=True):
    """One message in the buffer, with clock Data, where its time is the sender's stamp."""

    received: int
    """The stamp, in nanoseconds: with clock Data this is the only time."""
    number: int
    """The order of arrival; distinguishes samples of the same time."""
    payload: bytes
    """The message as received, undecoded."""
    key: str
    """The full key of the message."""

    @property
    def time(self) -> int:
        """Its time on the engine's time axis; nanoseconds."""
        return self.received


class PreviousSample(msgspec.Struct, frozen=True, gc=False, order=True):
    """The previous sample of the same client and stream."""

    payload: bytes
    """The whole message, undecoded."""
    place: int
    """The item's index in the message's list; -1: the stream has no items."""


class LinkedSample(msgspec.Struct, frozen=True, gc=False, order=True):
    """One message in the buffer, for a stream where a rule reads `before`."""

    received: int
    """By the clock: when the intake received the message, or its stamp; nanoseconds."""
    number: int
    """The order of arrival."""
    payload: bytes
    """The message as received, undecoded."""
    key: str
    """The full key of the message."""
    before: PreviousSample | None
    """None: this is the first sample, or the previous one was stale."""

    @property
    def time(self) -> int:
        """Its time on the engine's time axis; nanoseconds."""
        return self.received


class Item(msgspec.Struct, frozen=True, gc=False, order=True):
    """One item of a message in the buffer, for a stream with `items`. The items of a message share its payload."""

    received: int
    """By the clock: when the intake received the message, or its stamp; nanoseconds."""
    number: int
    """The order of arrival of the messages."""
    payload: bytes
    """The whole message as received, undecoded."""
    key: str
    """The full key of the message."""
    place: int
    """The item's index in the message's list."""
    share: int
    """Its share of the payload's memory, in bytes."""
    before: PreviousSample | None
    """As in a linked message; also None if no rule reads it."""

    @property
    def time(self) -> int:
        """Its time on the engine's time axis; nanoseconds."""
        return self.received


Sample = Arrival | StampedSample | LinkedSample | Item
"""One sample in the buffer. With clock Wall this is the queued arrival itself, without a copy."""


class DecodeError(ValueError):
    """A payload that its codec cannot read; the text names the reason."""


class Decoder(Protocol):
    """Reads the payloads of one stream. Stateless; raises only `DecodeError`."""

    def decode(self, payload: bytes) -> Any:
        """The message as plain maps, lists, strings, booleans, None, bytes and floats (integers as doubles).

        Integers beyond 2^53 stay integers. NaN and infinities are allowed. Arrays are lists.
        """

    def stamp(self, payload: bytes) -> int | None:
        """The sender's time in nanoseconds since the epoch, or None if the message has none."""


@runtime_checkable
class NearDecoder(Decoder, Protocol):
    """Reads messages that contain only a remainder of their time, such as milliseconds that recur every minute."""

    def stamp_near(self, payload: bytes, received: int) -> int | None:
        """The sender's time nearest to the receive time; nanoseconds since the epoch. Used instead of `stamp`."""


FieldColumn = Sequence[Any] | NDArray[np.float64]
"""A value for each payload: plain as from `decode`, or MISSING. An array: all are doubles."""


class Fields(NamedTuple):
    """Some fields of several messages."""

    columns: Sequence[FieldColumn]
    """By path."""
    errors: Mapping[int, DecodeError]
    """The payloads that cannot be read, by their indices; they are MISSING in all columns."""
    odd: Sequence[int]
    """Indices of the messages in which a path goes through a value without members, such as a number, a text or null,
    or a list where a name is expected. An expression over these needs the whole message. Ascending and unique."""


FieldReader = Callable[[Sequence[bytes]], Fields]
"""Reads the same fields of many payloads. Raises nothing: payloads that cannot be read are in `errors`."""


@runtime_checkable
class FieldDecoder(Decoder, Protocol):
    """Reads single fields faster than whole messages."""

    def field_reader(self, paths: Sequence[tuple[str | int, ...]]) -> FieldReader | None:
        """A reader of only these paths below `msg`, none of them empty: names of fields, and indices of lists.

        It returns the same values as `decode`, and rejects the same payloads with the same errors. None if these paths
        can only be read from whole messages.
        """
