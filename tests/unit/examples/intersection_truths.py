"""The expected results of the intersection's rules, in plain numpy and without the detector.

A truth is a row of ticks for each subject: 1 where the rule's condition is true, 0 where it is false, NaN where it is
unknown.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations, permutations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from examples.intersection.generator import RED, SECONDS, sent

TICKS = SECONDS * 10
Doubles = NDArray[np.float64]
Rows = dict[str, Doubles]


class Span(NamedTuple):
    """An episode, in ticks; without an end that the truth can know."""

    subject: str
    start: int
    end: int | None


# The data at each tick


class User:
    """A road user at each tick: its newest sample and the age of that."""

    def __init__(self, name: str, times: Doubles, fields: dict[str, Any]) -> None:
        self.name = name
        self.ticks = np.round(times * 10).astype(int)
        self.fields = {field: np.array(values, float) for field, values in fields.items()}
        newest = np.searchsorted(self.ticks, np.arange(TICKS), "right") - 1
        self.newest = np.maximum(newest, 0)
        self.age = np.where(newest < 0, np.inf, np.arange(TICKS) - self.ticks[self.newest])

    def held(self, values: Doubles, *, back: int = 0) -> Doubles:
        """The value of the newest sample, or of that before it; unknown after 5 s."""
        at = self.newest - back
        return np.where((self.age <= 50) & (at >= 0), np.asarray(values, float)[np.maximum(at, 0)], np.nan)

    def over(self, ticks: int, of: Callable[[slice], float], least: int = 1) -> Doubles:
        """A function of the samples of the last ticks; unknown where there are too few, or none for 5 s."""
        rows = np.full(TICKS, np.nan)
        for tick in np.flatnonzero(self.age <= 50).tolist():
            first, last = np.searchsorted(self.ticks, [tick - ticks, tick], "right")
            if last - first >= least:
                rows[tick] = of(slice(first, last))
        return rows

    @property
    def x(self) -> Doubles:
        return self.fields["x"]

    @property
    def y(self) -> Doubles:
        return self.fields["y"]

    @property
    def speed(self) -> Doubles:
        return self.fields["speed"]

    def within(self, west: float, south: float, east: float, north: float) -> Doubles:
        """Whether each sample lies in a rectangle."""
        return ((self.x >= west) & (self.x <= east) & (self.y >= south) & (self.y <= north)).astype(float)


USERS = {
    each.client: User(each.client, each.times, each.fields)
    for each in sorted(sent(), key=lambda each: each.client)
    if each.stream == "state"
}
CROSSING, CONFLICT, SCHOOL = (-8, -8, 8, 8), (0, -4, 4, 0), (20, -9, 60, 6)
INNER, OUTER, APPROACH = (-120, -3.75, 200, -0.25), (-120, -7.25, 200, -3.75), (-80, -3.75, -8, -0.25)


class Pair:
    """b in the frame of a at each tick, by complex numbers; NaN while a place is older than a second."""

    def __init__(self, a: User, b: User) -> None:
        self.subject = f"{a.name}+{b.name}"
        place, velocity = [], []
        for each in (a, b):
            known = np.where(each.age <= 10, 1.0, np.nan)
            place.append((each.held(each.x) + 1j * each.held(each.y)) * known)
            velocity.append(each.held(each.speed) * np.exp(1j * each.held(each.fields["yaw"])))
        turn = np.exp(-1j * a.held(a.fields["yaw"]))
        self.d, self.v = (place[1] - place[0]) * turn, (velocity[1] - velocity[0]) * turn
        self.heading = np.degrees(np.angle(np.exp(1j * (b.held(b.fields["yaw"]) - a.held(a.fields["yaw"])))))


def true(*conditions: Any) -> Doubles:
    """Whether all hold; one that is false decides. A condition is booleans, or (booleans, where they are known)."""
    rows = np.ones(TICKS)
    for each in conditions:
        values = np.asarray(each, float)
        rows = np.where((rows == 0) | (values == 0), 0.0, rows * values)
    return rows


def known(condition: Any, *of: Doubles) -> Doubles:
    """The condition, unknown where one of these is."""
    unknown = np.isnan(np.array(of)).any(axis=0)
    return np.where(unknown, np.nan, np.asarray(condition, float))


def spans(rows: Rows, hold: int = 0, near: dict[str, NDArray[np.bool_]] | None = None) -> list[Span]:
    """The episodes: from where it is true and has been for `hold` ticks, to where it is false."""
    found = []
    for subject, row in rows.items():
        start: int | None = None
        onset: int | None = None
        for tick, value in enumerate(row.tolist()):
            if start is None:
                reach = near is None or bool(near[subject][tick])
                onset = (tick if onset is None else onset) if value == 1 and reach else None
                start = tick if onset is not None and tick - onset >= hold else None
            elif value == 0:
                found.append(Span(subject, start, tick))
                start = onset = None
        if start is not None:
            found.append(Span(subject, start, None))
    return sorted(found)


def pairs(condition: Callable[[Pair], Doubles], within: float, *, ordered: bool) -> list[Span]:
    """The episodes of pairs, which begin within a reach only."""
    each = [Pair(a, b) for a, b in (permutations if ordered else combinations)(USERS.values(), 2)]
    with np.errstate(all="ignore"):
        near = {pair.subject: np.abs(pair.d) <= within for pair in each}
        return spans({pair.subject: condition(pair) for pair in each}, near=near)


def clients(condition: Callable[[User], Doubles], hold: int = 0) -> list[Span]:
    with np.errstate(all="ignore"):
        return spans({name: condition(user) for name, user in USERS.items()}, hold)


# The truths


def time_to_collision(pair: Pair) -> Doubles:
    """The smaller root of |d + v t| = 2.5 m."""
    a, b = np.abs(pair.v) ** 2, (pair.d * np.conj(pair.v)).real
    c = np.abs(pair.d) ** 2 - 2.5**2
    root = b * b - a * c
    with np.errstate(all="ignore"):
        time = np.where(c <= 0, 0.0, np.where((root >= 0) & (b < 0), (-b - np.sqrt(root)) / a, np.inf))
    return np.where(np.isnan(pair.d.real + pair.v.real), np.nan, time)


def near_miss(below: float = 2) -> list[Span]:
    def colliding(pair: Pair) -> Doubles:
        time = time_to_collision(pair)
        return known(time < below, time)

    return pairs(colliding, 60, ordered=False)


def acceleration(user: User) -> Doubles:
    """Over half a second, in m/s²."""

    def rate(window: slice) -> float:
        return float(np.ptp(user.ticks[window]) and np.diff(user.speed[window]).sum() / np.ptp(user.ticks[window])) * 10

    return user.over(5, rate, least=2)


def hard_braking() -> list[Span]:
    def braking(user: User) -> Doubles:
        rates = acceleration(user)
        return known(rates < -5, rates)

    return clients(braking)


def stationary() -> list[Span]:
    return clients(lambda user: user.held(user.within(*CROSSING) * (user.speed < 0.3)), hold=50)


def cut_in() -> list[Span]:
    def cutting(pair: Pair) -> Doubles:
        ahead, left = pair.d.real, pair.d.imag
        inward = left * pair.v.imag < -0.5
        return known(
            (ahead > 0) & (ahead < 15) & (abs(left) < 1.8) & inward & (abs(pair.heading) < 45), ahead, pair.v.imag
        )

    return pairs(cutting, 30, ordered=True)


def overtaking() -> list[Span]:
    def passing(pair: Pair) -> Doubles:
        beside = (abs(pair.d.real) < 4) & (pair.d.imag < -2) & (pair.d.imag > -6)
        return known(beside & (pair.v.real < -2) & (abs(pair.heading) < 20), pair.d.real, pair.v.real)

    return pairs(passing, 30, ordered=True)


def wrong_way() -> list[Span]:
    def against(user: User) -> Doubles:
        in_lane = np.maximum(user.within(*INNER), user.within(*OUTER))
        return user.held(in_lane * (np.cos(user.fields["yaw"]) < np.cos(np.radians(150))))

    return clients(against, hold=3)


def _crossed(user: User) -> Doubles:
    """Whether the newest sample is the first beyond the stop line."""
    before, now = user.held(user.x, back=1), user.held(user.x)
    y = user.held(user.y)
    return known((before < -8) & (now >= -8) & (y > -7.25) & (y < 0), before, now)


def stop_line() -> list[Span]:
    def running(user: User) -> Doubles:
        slowest = user.over(20, lambda window: float(user.speed[window].min()))
        return true(_crossed(user), known(slowest > 0.5, slowest))

    return clients(running)


def red_light() -> list[Span]:
    ticks = np.arange(TICKS) / 10
    red = np.any([(ticks >= begin - 0.01) & (ticks < end - 0.01) for begin, end in RED], axis=0)
    return clients(lambda user: true(red, _crossed(user)))


def _count(flag: Callable[[User], Doubles]) -> list[Span]:
    rows = [user.held(flag(user)) == 1 for user in USERS.values()]
    return spans({"~fleet": (np.sum(rows, axis=0) >= 3).astype(float)})


def queue() -> list[Span]:
    return _count(lambda user: user.within(*APPROACH) * (user.speed < 1))


def occupancy() -> list[Span]:
    return _count(lambda user: user.within(*CROSSING))


def vanished() -> list[Span]:
    return clients(lambda user: true(user.held(user.within(*CROSSING)), user.age >= 10))


def position_jump() -> list[Span]:
    def jumped(user: User) -> Doubles:
        step = np.concatenate(([np.nan], np.hypot(np.diff(user.x), np.diff(user.y))))
        step = user.held(step)
        return known(step > 5, step)

    return clients(jumped)


def rate_drop() -> list[Span]:
    def dropped(user: User) -> Doubles:
        counts = [np.array([((user.ticks > t - w) & (user.ticks <= t)).sum() for t in range(TICKS)]) for w in (10, 50)]
        return ((counts[0] >= 1) & (counts[0] < 5) & (counts[1] >= 20)).astype(float)

    return clients(dropped, hold=10)


def braked_then_stood() -> list[Span]:
    ticks = np.arange(TICKS)
    rows = {name: np.zeros(TICKS) for name in USERS}
    for stood in stationary():
        active = (ticks >= stood.start) & (ticks < (TICKS if stood.end is None else stood.end))
        for braked in hard_braking():
            if braked.subject == stood.subject:
                rows[stood.subject] += active & (ticks >= braked.start) & (ticks < braked.start + 100)
    return spans({name: np.minimum(row, 1) for name, row in rows.items()})


def lane_change() -> list[Span]:
    def changing(user: User) -> Doubles:
        lane = np.where(user.within(*INNER) == 1, 1, np.where(user.within(*OUTER) == 1, 2, 0))
        change = np.concatenate(([0], (lane[1:] != lane[:-1]) & (lane[1:] > 0) & (lane[:-1] > 0)))
        along = np.cos(user.fields["yaw"]) > np.cos(np.radians(45))
        return user.held(change * along)

    return clients(changing)


def too_fast() -> list[Span]:
    def fast(user: User) -> Doubles:
        flags = user.within(*SCHOOL) * (user.speed > 8.33)
        return user.over(5, lambda window: float(flags[window].all()))

    return clients(fast)


def post_encroachment() -> list[Span]:
    def reached(pair: Pair) -> Doubles:
        a, b = (USERS[name] for name in pair.subject.split("+"))
        left, entered = a.within(*CONFLICT), b.within(*CONFLICT)
        lately = np.nan_to_num(a.over(15, lambda window: float(left[window].any())))
        return true(lately, 1 - a.held(left), b.held(entered), 1 - b.held(entered, back=1))

    return pairs(reached, 60, ordered=True)


TRUTHS: dict[str, Callable[[], list[Span]]] = {
    "near-miss": near_miss,
    "least-time-to-collision": lambda: near_miss(4),
    "hard-braking": hard_braking,
    "standing": stationary,
    "cut-in": cut_in,
    "overtaking": overtaking,
    "wrong-way": wrong_way,
    "stop-line": stop_line,
    "red-light": red_light,
    "queue": queue,
    "vanished": vanished,
    "position-jump": position_jump,
    "rate-drop": rate_drop,
    "braked-then-stood": braked_then_stood,
    "occupancy": occupancy,
    "lane-change": lane_change,
    "too-fast": too_fast,
    "post-encroachment": post_encroachment,
}
