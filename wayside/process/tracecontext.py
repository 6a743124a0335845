"""The position of a span in its trace, in W3C's Trace Context format (https://www.w3.org/TR/trace-context/). Pure.

The ids of a detector's spans are derived from the ID of the episode. So a replay, a restarted detector and every
receiver of the episode compute the same trace.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

_TRACEPARENT = re.compile(r"00-(?!0{32})([0-9a-f]{32})-(?!0{16})([0-9a-f]{16})-([0-9a-f]{2})")
_SAMPLED = 0x01

Attribute = str | int | float | bool | Sequence[str]


@dataclass(frozen=True, slots=True)
class TraceContext:
    """A span: the 128-bit id of its trace, its own 64-bit id, and whether the trace is recorded."""

    trace_id: int
    span_id: int
    sampled: bool = True

    def __str__(self) -> str:
        """The header `traceparent`."""
        return f"00-{self.trace_id:032x}-{self.span_id:016x}-{int(self.sampled):02x}"

    def child(self, name: str) -> TraceContext:
        """A span of the same trace. The same parent and name always give the same span."""
        return replace(self, span_id=_number(f"{self.trace_id:032x}", f"{self.span_id:016x}", name, bits=64))


@dataclass(frozen=True, slots=True)
class Span:
    """A completed span. Times are nanoseconds since the epoch."""

    name: str
    start: int
    end: int
    parent: TraceContext | None = None
    context: TraceContext | None = None
    """Its own position; None: any position in its parent's trace."""
    attributes: Mapping[str, Attribute] = field(default_factory=dict)
    links: Sequence[TraceContext] = ()
    """Related spans, mostly of other traces."""
    error: str | None = None
    """The reason of the failure; None if there was none."""


def parse_traceparent(text: object) -> TraceContext | None:
    """The span of a header `traceparent`; None if it is not a valid header of version 00."""
    found = _TRACEPARENT.fullmatch(text) if isinstance(text, str) else None
    if found is None:
        return None
    return TraceContext(int(found[1], 16), int(found[2], 16), bool(int(found[3], 16) & _SAMPLED))


def episode_context(episode: str) -> TraceContext:
    """The span of an episode, by its ID. It is the root of its trace."""
    return TraceContext(_number("trace", episode, bits=128), _number("episode", episode, bits=64))


def _number(*parts: str, bits: int) -> int:
    """A number by a hash over the parts. It is never zero, which is not a valid id; no part may contain a NUL."""
    digest = hashlib.sha256("\0".join(parts).encode()).digest()
    return int.from_bytes(digest[: bits // 8], "big") or 1
