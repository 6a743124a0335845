"""Values and conditions over time. Each is valid from its time until the next, as in the engine."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int64]
Doubles = NDArray[np.float64]
Bytes = NDArray[np.uint8]

FALSE, TRUE, UNKNOWN, AWAY = 0, 1, 2, 3
"""The values of a condition; AWAY: the rule does not evaluate the subject, which is out of its scope or reach."""

WORDS = ("false", "true", "unknown", "away")


Wanted = Callable[[str, str], bool]
"""Whether a subject is wanted, by the rule's name and the subject's text."""


class SeriesKind(StrEnum):
    """The kind of values in a series."""

    NUMBER = "number"
    BOOLEAN = "boolean"
    TEXT = "text"


@dataclass(frozen=True, slots=True)
class Series:
    """One value of a subject."""

    times: Integers
    """int64[n], nanoseconds since the epoch, ascending: the times of changes."""
    values: Doubles
    """float64[n]: the number, 1.0 or 0.0 of a boolean, an index into `texts`; NaN: unknown."""
    kind: SeriesKind = SeriesKind.NUMBER
    texts: Sequence[str] = ()

    def at(self, times: Integers) -> Doubles:
        """The values at these times; NaN before the first."""
        return _valid_at(times, self.times, self.values, np.nan)

    def plain(self, value: float) -> float | bool | str | None:
        """A value of the series in JSON's form; None: unknown."""
        if value != value:  # noqa: PLR0124  NaN alone differs
            return None
        match self.kind:
            case SeriesKind.BOOLEAN:
                return value != 0
            case SeriesKind.TEXT:
                return self.texts[int(value)]
        return value


@dataclass(frozen=True, slots=True)
class Steps:
    """The values of one condition for a subject."""

    times: Integers
    """int64[n], nanoseconds since the epoch, ascending: the times of changes."""
    codes: Bytes
    """uint8[n]: FALSE, TRUE, UNKNOWN or AWAY."""
    reasons: Mapping[int, str] = field(default_factory=dict)
    """By index, why it is unknown from there on."""

    def at(self, times: Integers) -> Bytes:
        """The values at these times; AWAY before the first."""
        return _valid_at(times, self.times, self.codes, AWAY)


_Number = TypeVar("_Number", bound=np.generic)


def _valid_at(wanted: Integers, times: Integers, values: NDArray[_Number], before: float) -> NDArray[_Number]:
    """The values that are valid at the wanted times; `before` ahead of the first one."""
    found = np.full(len(wanted), before, values.dtype)
    where = np.searchsorted(times, wanted, "right") - 1
    found[where >= 0] = values[where[where >= 0]]
    return found


def codes_of(true: NDArray[np.bool_], false: NDArray[np.bool_]) -> Bytes:
    """The codes of conditions in Kleene's logic, in the same shape."""
    return np.where(true, np.uint8(TRUE), np.where(false, np.uint8(FALSE), np.uint8(UNKNOWN)))


def steps_of(times: Integers, codes: Bytes, reasons: Mapping[tuple[int, int], str], key: int) -> Steps:
    """A condition's values; `reasons`: why it is unknown, by a key and a time."""
    found = ((at, reasons.get((key, int(times[at])))) for at in np.flatnonzero(codes == UNKNOWN).tolist())
    return Steps(times, codes, {at: why for at, why in found if why is not None})


@dataclass(slots=True)
class SubjectTrace:
    """The trace of a rule for one subject."""

    rule: str
    subject: str
    clients: tuple[str, ...]
    signals: dict[str, Series] = field(default_factory=dict)
    """By the name in expressions: `speed`, for a pair `distance` and `a.speed`."""
    conditions: dict[str, Steps] = field(default_factory=dict)
    """`when`, and `until` if the rule has one."""

    @property
    def changes(self) -> Integers:
        """The times at which a condition changes, sorted."""
        times = [steps.times for steps in self.conditions.values()]
        return np.unique(np.concatenate(times)) if times else np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True)
class ClientPath:
    """The path of a client."""

    times: Integers
    axes: Doubles
    """Shape (2, n): x and y in metres, or latitude and longitude in degrees."""


_AXES = {("x", "y"): False, ("latitude", "longitude"): True}
"""Signals that form a position, and whether it is in degrees."""


def paths_of(subjects: Sequence[SubjectTrace]) -> tuple[dict[str, ClientPath], bool]:
    """By client, its path, from the signals `x` and `y`, or `latitude` and `longitude`, of the first rule that has
    them.

    Also whether the paths are in degrees. Empty if no rule about clients has these signals.
    """
    for axes, geographic in _AXES.items():
        having = [each for each in subjects if len(each.clients) == 1 and _have(each, axes)]
        if having:
            paths: dict[str, ClientPath] = {}
            for subject in having:
                if subject.rule == having[0].rule and subject.clients[0] not in paths:
                    series = [subject.signals[axis] for axis in axes]
                    times = np.unique(np.concatenate([each.times for each in series]))
                    places = np.stack([each.at(times) for each in series])
                    known = ~np.isnan(places).any(axis=0)
                    if known.any():
                        paths[subject.clients[0]] = ClientPath(times[known], places[:, known])
            return paths, geographic
    return {}, False


def _have(subject: SubjectTrace, axes: Sequence[str]) -> bool:
    return all(axis in subject.signals and subject.signals[axis].kind is SeriesKind.NUMBER for axis in axes)


@dataclass(slots=True)
class Trace:
    """The trace of a replay of one recording."""

    subjects: list[SubjectTrace] = field(default_factory=list)
    """In order of the rules' names, then of the subjects."""
    paths: dict[str, ClientPath] = field(default_factory=dict)
    """By client, if known."""
    geographic: bool = False
    """Whether paths are in degrees."""
    begin: int = 0
    end: int = 0
    """The first and the last tick, nanoseconds since the epoch."""


def thinned(series: Series, begin: int, end: int, buckets: int, exact: Integers) -> Series:
    """The series with the minimum and the maximum of each of `buckets` equal periods, and with exact points.

    The following points are preserved as well: the first and the last, changes between known and unknown, and the
    values at the times `exact` and before each of them.

    Args:
        series: any; one with few points is returned unchanged.
        begin: nanoseconds since the epoch.
        end: not before `begin`.
        buckets: at least one.
        exact: times, nanoseconds since the epoch.
    """
    count = len(series.times)
    if count <= 2 * buckets:
        return series
    values = series.values
    known = ~np.isnan(values)
    kept = np.zeros(count, bool)
    kept[[0, -1]] = True
    kept[1:] |= known[1:] != known[:-1]
    kept[:-1] |= known[1:] != known[:-1]
    span = max(end - begin, 1)
    bucket = ((series.times - begin).astype(float) * (buckets / span)).astype(np.int64)
    starts = np.flatnonzero(np.diff(bucket, prepend=bucket[0] - 1))
    which = np.cumsum(np.diff(bucket, prepend=bucket[0]) != 0)
    for reduce, nothing in ((np.minimum, np.inf), (np.maximum, -np.inf)):
        filled = np.where(known, values, nothing)
        extreme = reduce.reduceat(filled, starts)
        hits = np.flatnonzero(known & (filled == extreme[which]))
        kept[hits[np.diff(which[hits], prepend=-1) != 0]] = True
    holding = np.searchsorted(series.times, exact, "right") - 1
    kept[holding[holding >= 0]] = True
    kept[holding[holding > 0] - 1] = True
    return Series(series.times[kept], values[kept], series.kind, series.texts)
