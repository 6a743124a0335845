"""Raw: bytes that only functions of expressions, plugins and recordings interpret."""

from __future__ import annotations


class RawDecoder:
    """Returns the payload itself; expressions can read its size (`sample.size`), and pass the bytes to functions."""

    def decode(self, payload: bytes) -> bytes:
        """The payload."""
        return payload

    def stamp(self, payload: bytes) -> int | None:
        """None: the meaning of the bytes is unknown."""
        return None
