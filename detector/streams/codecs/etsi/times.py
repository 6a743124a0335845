"""ITS time: milliseconds of TAI since 2004-01-01T00:00:00Z (ETSI TS 102 894-2, TimestampIts), and fields that contain
only a remainder of it.

All times here are nanoseconds since the Unix epoch unless a name states otherwise.
"""

from __future__ import annotations

import datetime

_SECOND = 10**9
_MILLISECOND = 10**6

_UTC = datetime.UTC


def _seconds(year: int, month: int, day: int) -> int:
    return int(datetime.datetime(year, month, day, tzinfo=_UTC).timestamp())


EPOCH = _seconds(2004, 1, 1)
"""The beginning of ITS time, in seconds since the Unix epoch."""

_LEAPS = tuple(
    _seconds(*day) for day in ((2006, 1, 1), (2009, 1, 1), (2012, 7, 1), (2015, 7, 1), (2017, 1, 1))
)  # fmt: skip
"""The days that began after a leap second since then (IERS Bulletin C); there has been none since 2017."""

WRAP = 65536
"""generationDeltaTime is ITS time in milliseconds modulo this."""


def unix_ns(milliseconds: int) -> int:
    """The Unix time of an ITS time, in nanoseconds since the epoch."""
    seconds = milliseconds // 1000
    leaps = sum(seconds >= day - EPOCH + index + 1 for index, day in enumerate(_LEAPS))
    return (EPOCH - leaps) * _SECOND + milliseconds * _MILLISECOND


def its_ms(unix: int) -> int:
    """The ITS time, in milliseconds, of a Unix time in nanoseconds; negative before 2004."""
    leaps = sum(unix >= day * _SECOND for day in _LEAPS)
    return (unix - (EPOCH - leaps) * _SECOND) // _MILLISECOND


def nearest_time(remainder: int, near: int) -> int:
    """The Unix time nearest to `near` whose ITS time leaves the remainder modulo 65 536 ms."""
    reference = its_ms(near)
    ahead = (remainder - reference) % WRAP
    return unix_ns(reference + (ahead if ahead <= WRAP // 2 else ahead - WRAP))


def in_year(minute: int, milliseconds: int, near: int) -> int:
    """The Unix time nearest to `near` that is this far into this minute of some year (UTC)."""
    year = datetime.datetime.fromtimestamp(near / _SECOND, _UTC).year
    candidates = [
        (_seconds(each, 1, 1) + minute * 60) * _SECOND + milliseconds * _MILLISECOND
        for each in range(max(year - 1, 1970), year + 2)
    ]
    return min(candidates, key=lambda time: abs(time - near))
