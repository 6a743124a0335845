"""A use case's `scenario.py`: its messages and its expected results."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from examples.running.playing import Played

SECOND = 1_000_000_000
"""Nanoseconds."""
START_NS = int(datetime(2026, 1, 1, tzinfo=UTC).timestamp()) * SECOND
"""The stamp of second 0 of each scenario, in nanoseconds since the epoch."""


@dataclass(frozen=True, slots=True)
class Message:
    """One message, sent `after_ns` nanoseconds after second 0 under a Zenoh key."""

    after_ns: int
    key: str
    payload: bytes
    encoding: str = "json"
    type: str = ""
    """The ROS 2 message type, of encoding cdr."""


@dataclass(frozen=True, slots=True)
class Episode:
    """An episode that must be found. Seconds into the scenario; `end_s` is None where it is still open at the end."""

    rule: str
    subject: str
    start_s: float
    end_s: float | None = None
    within_s: float = 1.0
    """Its start and end are found this much later at most: the rule looks, and samples come, now and then."""
    reason: str = "Until"


@dataclass(frozen=True, slots=True)
class Moment:
    """The applications that must run at a moment without a change nearby."""

    at_s: float
    runs: Mapping[str, Mapping[str, Any]]
    """By `<template>/<key>`: the expected values of its configuration. Nothing else runs."""
    suspended: Collection[str] = ()
    """The suspended ones; the others must not be suspended."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """The messages and the expected results, both independent of the detector."""

    title: str
    seed: int
    messages: Callable[[], Iterable[Message]]
    """In any order; the same each time."""
    episodes: Sequence[Episode]
    actions: Mapping[str, int]
    """The expected number of episodes of each `<rule>/<action>`; of tasks for deploy actions."""
    picture: Callable[[], str]
    """An SVG."""
    picture_file: str = "scenario.svg"
    real_time: bool = False
    """Whether it can only be played in real time, because its messages contain only a part of the time."""
    moments: Sequence[Moment] = ()
    """The expected applications, for a use case with templates."""
    check: Callable[[Played], Iterable[str]] = field(default=lambda played: ())
    """Other differences from the expected results, one line each: recordings, notifications, applications."""


def as_json(value: Mapping[str, Any]) -> bytes:
    """A JSON payload; numbers are rounded to six decimals, as senders do."""
    return json.dumps(_rounded(value), separators=(",", ":")).encode()


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 6)
    if isinstance(value, Mapping):
        return {key: _rounded(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(each) for each in value]
    return value
