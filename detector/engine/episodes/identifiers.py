"""Short identifiers derived from contents: 16 lowercase letters and digits of the SHA-256."""

from __future__ import annotations

import hashlib

_LETTERS = "abcdefghijklmnopqrstuvwxyz234567"
_PAIRS = [first + second for first in _LETTERS for second in _LETTERS]
_TEN_BITS = 0x3FF


def identifier(data: bytes) -> str:
    """The first 80 bits of the SHA-256 of the data, in lowercase base32: 16 letters and digits."""
    # base64.b32encode and .lower() take twice as long, and each episode needs an identifier.
    digest = hashlib.sha256(data).digest()
    return _base32(int.from_bytes(digest[:5], "big")) + _base32(int.from_bytes(digest[5:10], "big"))


def episode_id(holder: str, rule: str, subject: str, start: int) -> str:
    """The identifier of the episode that starts at this time, in nanoseconds since the epoch."""
    return identifier(f"{holder}\0{rule}\0{subject}\0{start}".encode())


def _base32(bits: int) -> str:
    """40 bits as eight characters."""
    return (
        _PAIRS[bits >> 30] + _PAIRS[bits >> 20 & _TEN_BITS] + _PAIRS[bits >> 10 & _TEN_BITS] + _PAIRS[bits & _TEN_BITS]
    )
