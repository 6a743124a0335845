"""Matches samples of several streams that have about the same stamp.

The first stream is the reference. A tuple is one sample of each stream such that

1. each is the nearest of its stream to the reference sample by stamp, and the reference sample is the nearest of its
   own stream to each of them (of two equally near ones, that with the smaller stamp; of equal stamps, the first),
2. the stamps of all of them lie within `slop` of each other.

So a sample is in at most one tuple, and the result depends neither on the order of arrival nor on where the search
begins.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence


def matched(stamps: Sequence[Sequence[int]], slop: int) -> list[tuple[int, ...]]:
    """The tuples, as indices into each stream's stamps, in order of the reference.

    Args:
        stamps: for each stream the stamps of its samples in ascending order; nanoseconds. The first stream is the
            reference.
        slop: maximum distance between the stamps of a tuple, in nanoseconds.
    """
    reference, *others = stamps
    found = []
    for index, stamp in enumerate(reference):
        members = [index]
        for other in others:
            if not other:
                return []
            near = nearest_index(other, stamp)
            if nearest_index(reference, other[near]) != index:
                break
            members.append(near)
        else:
            times = [of[member] for of, member in zip(stamps, members, strict=True)]
            if max(times) - min(times) <= slop:
                found.append(tuple(members))
    return found


def nearest_index(stamps: Sequence[int], time: int) -> int:
    """The index of the stamp nearest to `time`; of two equally near ones the smaller, of equal ones the first.

    `stamps` is ascending and not empty.
    """
    after = bisect_left(stamps, time)
    if after == 0:
        return 0
    before = stamps[after - 1]
    if after < len(stamps) and stamps[after] - time < time - before:
        return after
    return bisect_left(stamps, before)
