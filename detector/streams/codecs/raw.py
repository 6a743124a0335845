"""Raw: bytes that only functions of expressions, plugins and recordings look into."""

from __future__ import annotations


class RawDecoder:
    """Gives the payload itself; of it, an expression sees the size (`sample.size`) and what functions make of bytes."""

    def decode(self, payload: bytes) -> bytes:
        """The payload."""
        return payload

    def stamp(self, payload: bytes) -> int | None:
        """None: nothing is known of what the bytes mean."""
        return None
