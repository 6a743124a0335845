"""The position of a span in its trace, in W3C's Trace Context format (https://www.w3.org/TR/trace-context/). Pure.

The ids of what a detector does follow from the episode's id: a replay, a restarted detector, and every receiver of
the episode in another way, all come to the same trace.
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
    """A span: 128 bits that name its trace, 64 bits that name it, and whether the trace is recorded."""

    trace_id: int
    span_id: int
    sampled: bool = True

    def __str__(self) -> str:
        """The header `traceparent`."""
        return f"00-{self.trace_id:032x}-{self.span_id:016x}-{int(self.sampled):02x}"

    def child(self, name: str) -> TraceContext:
        """A span of the same trace; of the same parent and name, always the same one."""
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
    """Spans, mostly of other traces, that have to do with this one."""
    error: str | None = None
    """Why it failed, where it did."""


def parse_traceparent(text: object) -> TraceContext | None:
    """The span of a header `traceparent`; None where it is none of version 00."""
    found = _TRACEPARENT.fullmatch(text) if isinstance(text, str) else None
    if found is None:
        return None
    return TraceContext(int(found[1], 16), int(found[2], 16), bool(int(found[3], 16) & _SAMPLED))


def episode_context(episode: str) -> TraceContext:
    """The span of an episode, by its id: the first one of its trace."""
    return TraceContext(_number("trace", episode, bits=128), _number("episode", episode, bits=64))


def _number(*parts: str, bits: int) -> int:
    """A number other than zero, which names no span, by a hash over the parts; none of them holds a NUL."""
    digest = hashlib.sha256("\0".join(parts).encode()).digest()
    return int.from_bytes(digest[: bits // 8], "big") or 1
