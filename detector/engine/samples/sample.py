"""What enters the engine: samples, and how their payloads are read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import msgspec

from wayside.expressions.columns.values import MISSING

__all__ = ["MISSING"]

SAMPLE_OVERHEAD = 160
"""What a sample costs in memory beside its payload, in bytes: its object, its numbers and its places in queues."""


class Arrival(msgspec.Struct, frozen=True, gc=False, order=True):
    """One message as the intake queued it, before the engine has looked at it."""

    received: int
    """When the intake took it, in nanoseconds since the epoch. It never goes back; of equal times, the order counts."""
    stream: str
    """The Detector's stream that it came in on."""
    key: str
    """The full Zenoh key (or topic without its leading slash)."""
    payload: bytes
    """The message as it came, undecoded."""

    @property
    def time(self) -> int:
        """Its place on the engine's time axis, with clock Wall; nanoseconds."""
        return self.received


class Stamped(msgspec.Struct, frozen=True, gc=False, order=True):
    """One message in the buffer, with clock Data: its time is the sender's stamp."""

    received: int
    """The stamp, in nanoseconds: with clock Data there is no other time."""
    number: int
    """The order of arrival; distinguishes samples of the same time."""
    payload: bytes
    """The message as it came, undecoded."""
    key: str
    """The full key it came on."""

    @property
    def time(self) -> int:
        """Its place on the engine's time axis; nanoseconds."""
        return self.received


class Before(msgspec.Struct, frozen=True, gc=False, order=True):
    """The sample before another of the same client and stream."""

    payload: bytes
    """The whole message, undecoded."""
    place: int
    """The item's place in the message's list; -1: the stream has no items."""


class Linked(msgspec.Struct, frozen=True, gc=False, order=True):
    """One message in the buffer of a stream of which a rule reads `before`."""

    received: int
    """As of a sample of the clock: when the intake took the message, or its stamp; nanoseconds."""
    number: int
    """The order of arrival."""
    payload: bytes
    """The message as it came, undecoded."""
    key: str
    """The full key it came on."""
    before: Before | None
    """None: it is the first, or the one before it was stale."""

    @property
    def time(self) -> int:
        """Its place on the engine's time axis; nanoseconds."""
        return self.received


class Item(msgspec.Struct, frozen=True, gc=False, order=True):
    """One item of a message in the buffer, of a stream with `items`. The items of a message share its payload."""

    received: int
    """As of a sample of the clock: when the intake took the message, or its stamp; nanoseconds."""
    number: int
    """The order of arrival of the messages."""
    payload: bytes
    """The whole message as it came, undecoded."""
    key: str
    """The full key it came on."""
    place: int
    """The item's place in the message's list."""
    share: int
    """What it takes of the payload in memory, in bytes."""
    before: Before | None
    """As of a linked message; None as well where no rule reads it."""

    @property
    def time(self) -> int:
        """Its place on the engine's time axis; nanoseconds."""
        return self.received


Sample = Arrival | Stamped | Linked | Item
"""One sample in the buffer. With clock Wall a message is what the intake queued: none is copied."""


class DecodeError(ValueError):
    """A payload that its codec cannot read; the text names the reason."""


class Decoder(Protocol):
    """Reads the payloads of one stream. Stateless; raises nothing but `DecodeError`."""

    def decode(self, payload: bytes) -> Any:
        """The message as plain maps, lists, strings, booleans, None, bytes and floats (integers as doubles).

        Integers beyond 2^53 stay integers. NaN and infinities pass. Arrays are lists.
        """

    def stamp(self, payload: bytes) -> int | None:
        """The sender's time in nanoseconds since the epoch, or None where the message carries none."""


@runtime_checkable
class NearDecoder(Decoder, Protocol):
    """Reads messages that carry only a remainder of their time, such as milliseconds that recur every minute."""

    def stamp_near(self, payload: bytes, received: int) -> int | None:
        """The sender's time nearest to the receive time; nanoseconds since the epoch. Asked instead of `stamp`."""


class Fields(NamedTuple):
    """Some fields of several messages."""

    columns: Sequence[Sequence[Any]]
    """By path, a value for each payload: plain as `decode` gives it, or MISSING."""
    errors: Mapping[int, DecodeError]
    """The payloads that cannot be read, by their places among the payloads; they are MISSING in all columns."""
    odd: Sequence[int]
    """Places of the messages in which a path goes through what has no members, such as a number, a text or null, or a
    list where a name is expected. An expression over these needs the whole message. Ascending, each once."""


FieldReader = Callable[[Sequence[bytes]], Fields]
"""Reads the same fields of many payloads. Raises nothing: what cannot be read is in `errors`."""


@runtime_checkable
class FieldDecoder(Decoder, Protocol):
    """Reads single fields faster than whole messages."""

    def field_reader(self, paths: Sequence[tuple[str | int, ...]]) -> FieldReader | None:
        """A reader of just these paths below `msg`, none of them empty: names of fields, and indices of lists.

        It gives the values that `decode` gives, and refuses the payloads that `decode` refuses, with the same errors.
        None where these paths can only be read from whole messages.
        """
