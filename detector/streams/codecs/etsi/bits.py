"""The bits of a message in unaligned PER (ITU-T X.691): numbers of given numbers of bits, and the lengths that come in
several forms.
"""

from __future__ import annotations

from collections.abc import Iterator

from detector.engine.samples.sample import DecodeError

_FRAGMENT = 16384
"""A length of this size or more is sent in fragments of one to four times this number."""

_LONGEST = 8
"""Maximum bytes of an unbounded number."""

_ELEMENTS_PER_OCTET = 8
"""One per bit. The number of elements without bits would otherwise be unbounded."""


class Bits:
    """Reads bits from the beginning. Raises only DecodeError, for reads past the end."""

    __slots__ = ("_data", "_elements", "_end", "position")

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._end = len(data) * 8
        self.position = 0
        self._elements = _ELEMENTS_PER_OCTET * (len(data) + 1)

    def read(self, count: int) -> int:
        """The next `count` bits as a non-negative number."""
        start = self.position
        stop = start + count
        if stop > self._end:
            raise DecodeError(f"it ends after {self._end // 8} bytes, in the middle of a value")
        self.position = stop
        last = (stop + 7) >> 3
        return (int.from_bytes(self._data[start >> 3 : last], "big") >> (last * 8 - stop)) & ((1 << count) - 1)

    def octets(self, count: int) -> bytes:
        """The next `count` octets."""
        return self.read(8 * count).to_bytes(count, "big")

    def elements(self, count: int) -> int:
        """The same number, after checking that a message of this length can contain that number of elements."""
        self._elements -= count
        if self._elements < 0:
            raise DecodeError("it announces more elements than its length allows")
        return count

    def lengths(self) -> Iterator[int]:
        """An unbounded length, fragment by fragment; read the announced items before the next fragment (11.9)."""
        while True:
            if not self.read(1):
                yield self.read(7)
                return
            if not self.read(1):
                yield self.read(14)
                return
            pieces = self.read(6)
            if not 1 <= pieces <= 4:
                raise DecodeError(f"a length must have 1 to 4 fragments; got {pieces}")
            yield pieces * _FRAGMENT

    def blob(self) -> bytes:
        """Octets preceded by an unbounded length, the form of open types."""
        return b"".join([self.octets(length) for length in self.lengths()])

    def unsigned(self) -> int:
        """A non-negative number without an upper bound (11.7)."""
        return int.from_bytes(self._number(), "big")

    def signed(self) -> int:
        """An unbounded number (11.8)."""
        return int.from_bytes(self._number(), "big", signed=True)

    def _number(self) -> bytes:
        octets = self.blob()
        if len(octets) > _LONGEST:
            raise DecodeError(f"a number must have at most {_LONGEST} bytes; got {len(octets)}")
        return octets

    def small(self) -> int:
        """A normally small number (11.6)."""
        return self.unsigned() if self.read(1) else self.read(6)

    def small_length(self) -> int:
        """A normally small length, at least one (11.9.3.4)."""
        if not self.read(1):
            return self.read(6) + 1
        return sum(self.lengths())
