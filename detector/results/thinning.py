"""Reduces long series: the visible shape at a given width is preserved, and so is each important point."""

from __future__ import annotations

import numpy as np

from detector.results.series import Integers, Series


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
