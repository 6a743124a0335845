"""The data about an episode known from its start on, and its identifier. Events, demands and actions share it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import msgspec

from detector.engine.episodes.subjects import Subject
from wayside.api.base import JsonValue


class EpisodeRecord(msgspec.Struct, frozen=True, gc=False):
    """One occurrence of a rule's event, for one subject. Times are nanoseconds since the epoch."""

    id: str
    rule: str
    subject: str
    """The text in events: `car1`, `car1+car2`, `~fleet`, followed by `~` and the element of `each` if there is one."""
    clients: tuple[str, ...]
    """The clients of the subject."""
    element: str | None
    onset_time: int
    start_time: int
    values: Mapping[str, JsonValue]
    """The rule's variables at the start; unknown ones are left out."""
    classification: Mapping[str, JsonValue] | None
    rule_digest: str = ""
    """Digest of the rule's semantics under which it started."""

    @property
    def about(self) -> Subject:
        """The subject as clients and element."""
        return Subject(self.clients, self.element)


_LETTERS = "abcdefghijklmnopqrstuvwxyz234567"
_PAIRS = [first + second for first in _LETTERS for second in _LETTERS]
_TEN_BITS = 0x3FF


def identifier(data: bytes) -> str:
    """The first 80 bits of the SHA-256 of the data, in lowercase base32: 16 letters and digits."""
    # base64.b32encode and .lower() take twice as long, and each episode needs an identifier.
    digest, pairs = hashlib.sha256(data).digest(), _PAIRS
    head, tail = int.from_bytes(digest[:5], "big"), int.from_bytes(digest[5:10], "big")
    return (
        f"{pairs[head >> 30]}{pairs[head >> 20 & _TEN_BITS]}{pairs[head >> 10 & _TEN_BITS]}{pairs[head & _TEN_BITS]}"
        f"{pairs[tail >> 30]}{pairs[tail >> 20 & _TEN_BITS]}{pairs[tail >> 10 & _TEN_BITS]}{pairs[tail & _TEN_BITS]}"
    )


def episode_id(holder: str, rule: str, subject: str, start: int) -> str:
    """The identifier of the episode that starts at this time, in nanoseconds since the epoch."""
    return identifier(f"{holder}\0{rule}\0{subject}\0{start}".encode())
