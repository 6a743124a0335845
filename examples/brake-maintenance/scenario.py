"""A day of braking of three vans. The brakes of one wear out; another one's get hot on a pass.

The truth is how much deceleration a bar of brake pressure gives, over the hours. What is measured at each braking is
noisy.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from examples.running.drawing import Chart
from examples.running.playing import Played, seconds
from examples.running.scenario import SECOND, START_NS, Episode, Message, Scenario, as_json

SEED = 17
HOUR_S = 3600.0
HOURS = 14
PERIOD_S = 40.0
AS_NEW, LEAST = 0.0625, 0.045
"""(m/s²)/bar: 5 m/s² at 80 bar; and what must not be fallen short of."""
WEAR_PER_HOUR, WEARS_FROM_H = 0.0012, 2.0
PASS_H = (5.0, 5.6)
RECENT_H, LONGER_H, NOTICE_H, WORTH_IT = 2.0, 6.0, 12.0, 0.0008
ENOUGH, LASTING_H = 400, 1 / 6
NOISE = 0.015
UNCERTAIN_H = 1.0
"""By how many hours the noisy means may notify earlier or later."""

VANS = ("van-1", "van-2", "van-3")


def gives(van: str, hours: float) -> float:
    """The deceleration for each bar of pressure with cool brakes, in m/s²."""
    return AS_NEW - (WEAR_PER_HOUR * max(0.0, hours - WEARS_FROM_H) if van == "van-2" else 0.0)


def hot(van: str, hours: float) -> bool:
    """Whether the van comes down a pass."""
    return van == "van-3" and PASS_H[0] <= hours < PASS_H[1]


def scenario(seed: int = SEED) -> Scenario:
    """Fourteen hours of driving."""
    due = episodes()
    return Scenario(
        title="Predictive maintenance of brakes",
        seed=seed,
        messages=lambda: messages(seed),
        episodes=due,
        actions={"brake-maintenance/workshop": len(due)},
        picture=lambda: picture(seed, due),
        check=check,
    )


def messages(seed: int) -> Iterator[Message]:
    """Each braking of each van."""
    for van in VANS:
        for at, pressure, deceleration, temperature in brakings(van, seed):
            after = round(at * SECOND)
            content = {
                "stamp": (START_NS + after) / SECOND, "pressure": pressure, "deceleration": deceleration,
                "temperature": temperature,
            }  # fmt: skip
            yield Message(after, f"vehicles/{van}/brakings", as_json(content))


def brakings(van: str, seed: int) -> Iterator[tuple[float, float, float, float]]:
    """When, at which pressure (bar), with which deceleration (m/s²) and how hot (°C)."""
    rng = np.random.default_rng([seed, VANS.index(van)])
    at = float(rng.uniform(1, PERIOD_S))
    while at < HOURS * HOUR_S:
        pressure = float(rng.uniform(15, 60))
        hours = at / HOUR_S
        fading = 0.72 if hot(van, hours) else 1.0
        deceleration = pressure * gives(van, hours) * fading * (1 + NOISE * float(rng.standard_normal()))
        temperature = float(rng.uniform(300, 420) if hot(van, hours) else rng.uniform(60, 220))
        yield at, pressure, deceleration, temperature
        at += float(rng.uniform(0.5, 1.5)) * PERIOD_S


def hours_left(van: str, hours: float) -> float:
    """By the truth's means over both windows; infinite where nothing is lost."""
    recent, longer = (
        float(np.mean([gives(van, each) for each in np.arange(max(0.0, hours - window), hours, 0.02)]))
        for window in (RECENT_H, LONGER_H)
    )
    lost = (longer - recent) / 2
    return (recent - LEAST) / lost if lost > WORTH_IT else math.inf


def episodes() -> list[Episode]:
    """Once it is known for ten minutes that less than twelve hours are left."""
    found = []
    for van in VANS:
        onset: float | None = None
        for hours in np.arange(ENOUGH * PERIOD_S / HOUR_S, HOURS, 1 / 60):
            onset = (float(hours) if onset is None else onset) if hours_left(van, hours) < NOTICE_H else None
            if onset is not None and hours - onset >= LASTING_H:
                start = (float(hours) - UNCERTAIN_H) * HOUR_S
                found.append(Episode("brake-maintenance", van, start, None, 2 * UNCERTAIN_H * HOUR_S))
                break
    return found


def check(played: Played) -> Iterator[str]:
    """The workshop is notified of the brakes' remaining time."""
    reported = {each.content["subject"]: each.content["data"]["notification"]["labels"] for each in played.notices}
    for event in played.events:
        van = event.episode.subject
        logged, at = float(reported[van]["hours"]), seconds(event.episode.start_time) / HOUR_S
        truth = (gives(van, at - RECENT_H / 2) - LEAST) / WEAR_PER_HOUR
        if not abs(logged - truth) < 0.15 * truth:
            yield f"the workshop was notified that {van} has {logged:.1f} hours left; they are {truth:.1f}"


def picture(seed: int, due: Sequence[Episode]) -> str:
    """The measured brakings, and when the workshop is notified."""
    chart = Chart(HOURS * HOUR_S)
    curves = []
    for van in VANS:
        points = [(at, 1000 * deceleration / pressure) for at, pressure, deceleration, _ in brakings(van, seed)]
        curves.append((van, points[::4]))
    chart.curves("mm/s² per bar of pressure", curves, 40, 70, ("least", 1000 * LEAST))
    rows = [(each.subject, [(each.start_s + UNCERTAIN_H * HOUR_S, HOURS * HOUR_S, "")]) for each in due]
    chart.bars("workshop notified", rows, "#d1495b")
    return chart.svg()
