"""The channels in which Foxglove and Lichtblick display the evaluation, from a file or live.

Each rule and subject has a JSON channel with a schema; further channels contain the episodes, a log and the scene.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import msgspec
import numpy as np
from foxglove.messages import Log, LogLevel, Timestamp

from detector.engine.episodes.events import Event
from detector.results.result import Result
from detector.results.series import WORDS, Integers, Series, SeriesKind, SubjectTrace, thinned
from wayside.times import format_time

_TYPES = {SeriesKind.NUMBER: "number", SeriesKind.BOOLEAN: "boolean", SeriesKind.TEXT: "string"}
_SIGNS = {"+": "plus", "-": "minus", "*": "times", "/": "by"}


class _Field(NamedTuple):
    """One value of a message."""

    path: tuple[str, ...]
    kind: SeriesKind
    values: list[float | bool | str | None]


def topic_of(rule: str, subject: str) -> str:
    """The channel of a rule's subject."""
    return f"/wayside/{rule}/{subject}"


@lru_cache(maxsize=4096)
def message_path(name: str) -> tuple[str, ...]:
    """The path of a signal or term in a message: `a.speed` in `a`, `fastest - speed` under `fastest_minus_speed`."""
    if re.fullmatch(r"[\w.]+", name):
        return tuple(name.split("."))
    spelt = "".join(f" {_SIGNS[char]} " if char in _SIGNS else char for char in name)
    return (re.sub(r"\W+", "_", spelt).strip("_"),)


def subject_channel(
    result: Result, subject: SubjectTrace, buckets: int
) -> tuple[dict[str, Any], Iterator[tuple[int, bytes]]]:
    """The schema of a subject's channel, and its messages: all known values at each time at which one changes."""
    trace, terms, exact = result.trace, result.terms.get((subject.rule, subject.subject)), subject.changes
    named = {**subject.signals, **(terms.computed if terms is not None else {})}
    short = {name: thinned(series, trace.begin, trace.end, buckets, exact) for name, series in named.items()}
    times = np.unique(np.concatenate([exact, *(series.times for series in short.values())]))
    fields = [_Field(message_path(name), each.kind, _plain(each, times)) for name, each in named.items()]
    limits: dict[str, Any] = {}
    for each in terms.thresholds if terms is not None else ():
        _put(limits, (each.field, *message_path(each.term)), each.value)
    conditions = {name: steps.at(times).tolist() for name, steps in subject.conditions.items()}
    reasons = {name: _reasons(steps.reasons, steps.times, times) for name, steps in subject.conditions.items()}
    schema: dict[str, Any] = {"type": "object", "title": f"wayside.{subject.rule}", "properties": {}}
    for field in fields:
        _declare(schema, field.path, {"type": _TYPES[field.kind]})
    for name in conditions:
        _declare(schema, (name,), {"type": "string", "enum": [*WORDS]})
        _declare(schema, (f"{name}_reason",), {"type": "string"})
    if limits:
        schema["properties"]["threshold"] = _shape(limits)
    return schema, _messages(times, fields, conditions, reasons, limits)


def _messages(
    times: Integers,
    fields: list[_Field],
    conditions: Mapping[str, list[int]],
    reasons: Mapping[str, list[str | None]],
    limits: Mapping[str, Any],
) -> Iterator[tuple[int, bytes]]:
    encode = msgspec.json.Encoder().encode
    for row, time in enumerate(times.tolist()):
        message: dict[str, Any] = {}
        for path, _, values in fields:
            value = values[row]
            if value is not None:
                _put(message, path, value)
        for name, codes in conditions.items():
            message[name] = WORDS[codes[row]]
            reason = reasons[name][row]
            if reason is not None:
                message[f"{name}_reason"] = reason
        if limits:
            message["threshold"] = limits
        yield time, encode(message)


def _plain(series: Series, times: Integers) -> list[float | bool | str | None]:
    """The values at these times in JSON's form; None: unknown or infinite, which JSON cannot express."""
    values = series.at(times).tolist()
    if series.kind is SeriesKind.NUMBER:
        return [value if math.isfinite(value) else None for value in values]
    return [series.plain(value) for value in values]


def _reasons(reasons: Mapping[int, str], changes: Integers, times: Integers) -> list[str | None]:
    if not reasons:
        return [None] * len(times)
    where = np.searchsorted(changes, times, "right") - 1
    return [reasons.get(at) for at in where.tolist()]


def _put(message: dict[str, Any], path: tuple[str, ...], value: Any) -> None:
    for step in path[:-1]:
        message = message.setdefault(step, {})
    message[path[-1]] = value


def _declare(schema: dict[str, Any], path: tuple[str, ...], kind: dict[str, Any]) -> None:
    for step in path[:-1]:
        schema = schema["properties"].setdefault(step, {"type": "object", "properties": {}})
    schema["properties"][path[-1]] = kind


def _shape(values: Mapping[str, Any]) -> dict[str, Any]:
    properties = {
        name: _shape(value) if isinstance(value, Mapping) else {"type": "number"} for name, value in values.items()
    }
    return {"type": "object", "properties": properties}


EPISODES, LOG, SCENE = "/wayside/episodes", "/wayside/log", "/wayside/scene"

EPISODE: dict[str, Any] = {
    "type": "object",
    "title": "wayside.Episode",
    "properties": {
        **{name: {"type": "string"} for name in ("rule", "subject", "episode", "state", "start", "end", "reason")},
        "values": {"type": "object"},
    },
}


def episode_message(event: Event) -> dict[str, Any]:
    """The message of the channel of episodes."""
    episode = event.episode
    found: dict[str, Any] = {
        "rule": episode.rule,
        "subject": episode.subject,
        "episode": episode.id,
        "state": "started" if event.started else "ended",
        "start": format_time(episode.start_time),
    }
    if event.end_time is not None:
        found |= {"end": format_time(event.end_time), "reason": str(event.reason)}
    return {**found, "values": dict(event.values)}


def log_message(event: Event, time: int) -> Log:
    """A line for Foxglove's log panel; `time` is nanoseconds since the epoch."""
    ended = "" if event.started else f" ({event.reason})"
    return Log(
        timestamp=Timestamp(sec=time // 1_000_000_000, nsec=time % 1_000_000_000),
        level=LogLevel.Info,
        name=event.episode.rule,
        message=f"{event.episode.rule} of {event.episode.subject} {'started' if event.started else 'ended'}{ended}",
        file="",
        line=0,
    )
