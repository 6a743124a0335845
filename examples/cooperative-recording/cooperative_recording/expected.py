"""The expected applications, computed from the simulated positions alone.

This is the judge of the whole chain, so it shares nothing with it: no engine, no rules, no merging, only geometry and
interval arithmetic. Times are seconds into the drive, exact crossings of the thresholds; comparisons must allow for
the rule's evaluation period and for the time that starting and stopping take.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from cooperative_recording.network import Floats
from cooperative_recording.vehicles import LIDAR_VEHICLES, Drive

CLOSE = 150.0
"""Metres: nearer than this, a pair's episode starts."""
APART = 200.0
"""Metres: farther than this, it ends."""
LINGER = 3.0
"""Seconds that both templates let an instance stay after its last demand."""
STEP = 0.02
"""Seconds between the looks for crossings; two vehicles move at most 1.2 m relative to each other in it."""

Pair = tuple[str, str]


@dataclass(frozen=True, slots=True)
class Episode:
    """Two lidar vehicles close to each other, from start_s to end_s; end_s is None if the drive ends first."""

    pair: Pair
    start_s: float
    end_s: float | None
    place: str


@dataclass(frozen=True, slots=True)
class Span:
    """A time in which an instance should exist; end_s is None if it still does at the drive's end."""

    start_s: float
    end_s: float | None


@dataclass(frozen=True, slots=True)
class Fusion:
    """A time in which the fusion at a place should run with exactly these sources (sorted)."""

    place: str
    start_s: float
    end_s: float | None
    sources: tuple[str, ...]


def place_at(x: float) -> str:
    """The place that a point belongs to, by its x coordinate in metres: the old town or the crossroads."""
    return "west" if x < 0 else "east"


def lidar_pairs() -> list[Pair]:
    """All pairs of lidar vehicles, each with the smaller name first, sorted."""
    return list(itertools.combinations(sorted(vehicle.name for vehicle in LIDAR_VEHICLES), 2))


def distances(drive: Drive, pair: Pair, times: Floats) -> Floats:
    """Metres between the two vehicles at each of the times (s)."""
    a, b = (drive.poses(name, times)[:, :2] for name in pair)
    return np.asarray(np.hypot(*(a - b).T), dtype=np.float64)


def episodes(drive: Drive, duration_s: float) -> list[Episode]:
    """All episodes of the first duration_s seconds, by start, then pair. A pair close from the outset starts at 0."""
    found = [episode for pair in lidar_pairs() for episode in _of_pair(drive, pair, duration_s)]
    return sorted(found, key=lambda episode: (episode.start_s, episode.pair))


def recorders(episodes: Iterable[Episode], linger_s: float = LINGER) -> dict[Pair, list[Span]]:
    """When a recorder should exist for each pair. Meeting again within linger_s seconds keeps the one that is there."""
    spans: dict[Pair, list[Span]] = {}
    for episode in sorted(episodes, key=lambda episode: episode.start_s):
        spans.setdefault(episode.pair, []).append(Span(episode.start_s, _later(episode.end_s, linger_s)))
    return {pair: _joined(those) for pair, those in spans.items()}


def fusions(episodes: Iterable[Episode], linger_s: float = LINGER) -> dict[str, list[Fusion]]:
    """For each place, the times and sources of its fusion, in order.

    The sources are the vehicles of all pairs with an open episode there. While it only lingers they stay as they were.
    """
    result: dict[str, list[Fusion]] = {}
    everything = list(episodes)
    for place in sorted({episode.place for episode in everything}):
        here = [episode for episode in everything if episode.place == place]
        moments = sorted({episode.start_s for episode in here} | {e.end_s for e in here if e.end_s is not None})
        states: list[Fusion] = []
        for start, end in itertools.zip_longest(moments, moments[1:]):
            live = [e for e in here if e.start_s <= start and (e.end_s is None or e.end_s > start)]
            sources = tuple(sorted({name for episode in live for name in episode.pair}))
            if sources and states and states[-1].end_s == start and states[-1].sources == sources:
                states[-1] = Fusion(place, states[-1].start_s, end, sources)
            elif sources:
                states.append(Fusion(place, start, end, sources))
        result[place] = _lingering(states, linger_s)
    return result


def _of_pair(drive: Drive, pair: Pair, duration_s: float) -> list[Episode]:
    times = np.linspace(0.0, duration_s, round(duration_s / STEP) + 1)
    metres = distances(drive, pair, times)
    found: list[Episode] = []
    start: float | None = None
    for index, distance in enumerate(metres):
        if start is None and distance < CLOSE:
            start = _crossing(drive, pair, times, index, CLOSE)
        elif start is not None and distance > APART:
            found.append(Episode(pair, start, _crossing(drive, pair, times, index, APART), _place(drive, pair, start)))
            start = None
    if start is not None:
        found.append(Episode(pair, start, None, _place(drive, pair, start)))
    return found


def _crossing(drive: Drive, pair: Pair, times: Floats, index: int, threshold: float) -> float:
    if index == 0:
        return 0.0
    return float(
        brentq(
            lambda t: distances(drive, pair, np.array([t]))[0] - threshold, times[index - 1], times[index], xtol=1e-6
        )
    )


def _place(drive: Drive, pair: Pair, t: float) -> str:
    return place_at(sum(drive.pose(name, t).x for name in pair) / 2)


def _later(end: float | None, by: float) -> float | None:
    return None if end is None else end + by


def _joined(spans: list[Span]) -> list[Span]:
    joined: list[Span] = []
    for span in spans:
        if joined and (joined[-1].end_s is None or span.start_s <= joined[-1].end_s):
            joined[-1] = Span(joined[-1].start_s, span.end_s)
        else:
            joined.append(span)
    return joined


def _lingering(states: list[Fusion], linger_s: float) -> list[Fusion]:
    lasting = []
    for state, following in itertools.zip_longest(states, states[1:]):
        end = state.end_s
        if end is not None and (following is None or following.start_s > end):
            end += linger_s
            if following is not None:
                end = min(end, following.start_s)
        lasting.append(Fusion(state.place, state.start_s, end, state.sources))
    return lasting
