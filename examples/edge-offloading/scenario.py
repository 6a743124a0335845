"""Two vehicles and their round trips to the cloud; the one drives through a congested cell.

The truth is how long the way to the cloud takes over time. What is measured jitters around it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from examples.running.drawing import Chart
from examples.running.playing import Played, seconds
from examples.running.scenario import SECOND, START_NS, Episode, Message, Moment, Scenario, as_json

SEED = 4
DURATION_S = 60
PERIOD_NS = SECOND // 10
STEP_S = 0.02
WINDOW_S, LASTING_S = 3.0, 1.0
TOO_LONG_S, SHORT_AGAIN_S = 0.080, 0.050
JITTER_S = 0.003
WITHIN_S = 0.8
"""Means of jittering measurements cross a threshold a little sooner or later, and the rule looks every 0.2 s."""

TRUTH: dict[str, Sequence[tuple[float, float]]] = {
    # Four bad answers at second 6; a congested cell from 15 to 30; then neither good nor bad until 38.
    "car-1": [(0, 0.035), (6, 0.300), (6.4, 0.035), (15, 0.130), (30, 0.062), (38, 0.035)],
    # Neither good nor bad all the time: it stays where it is.
    "car-2": [(0, 0.062)],
}
"""From each second on, how long the round trip takes, in seconds."""


def round_trip(vehicle: str, t: float) -> float:
    """Seconds to the cloud and back, without jitter."""
    return next(value for begin, value in reversed(TRUTH[vehicle]) if begin <= t)


def scenario(seed: int = SEED) -> Scenario:
    """A minute."""
    due = episodes()
    return Scenario(
        title="Latency-aware edge offloading",
        seed=seed,
        messages=lambda: messages(seed),
        episodes=due,
        actions={"edge-offloading/edge": 1, "in-the-cloud/cloud": 3},
        moments=[moment(at) for at in (5.0, 10.0, 25.0, 36.0, 50.0)],
        picture=lambda: picture(seed, due),
        check=check,
    )


def messages(seed: int) -> Iterator[Message]:
    """The measurements of each vehicle, ten times a second."""
    for number, vehicle in enumerate(TRUTH):
        rng = np.random.default_rng([seed, number])
        for index in range(DURATION_S * SECOND // PERIOD_NS):
            after = index * PERIOD_NS + (number + 1) * SECOND // 50
            took = round_trip(vehicle, after / SECOND) + JITTER_S * rng.standard_normal()
            content = {"stamp": (START_NS + after) / SECOND, "roundTrip": took}
            yield Message(after, f"vehicles/{vehicle}/latency", as_json(content))


def edge_times(vehicle: str) -> list[tuple[float, float | None]]:
    """From the truth: when the mean has been too long for a second, until it is short again."""
    found: list[tuple[float, float | None]] = []
    onset: float | None = None
    start: float | None = None
    for step in range(round(0.5 / STEP_S), round(DURATION_S / STEP_S)):
        t = step * STEP_S
        mean = np.mean([round_trip(vehicle, each) for each in np.arange(max(0.0, t - WINDOW_S), t, 0.1)])
        if start is None:
            onset = (t if onset is None else onset) if mean > TOO_LONG_S else None
            start = t if onset is not None and t - onset >= LASTING_S else None
        elif mean < SHORT_AGAIN_S:
            found.append((start, t))
            onset = start = None
    return found if start is None else [*found, (start, None)]


def episodes() -> list[Episode]:
    """At the edge when it must be; else in the cloud."""
    found = []
    early = WITHIN_S / 2 - 0.1
    for vehicle in TRUTH:
        begin = 0.0
        for start, end in edge_times(vehicle):
            assert end is not None, "in this scenario every vehicle comes back"
            found.append(Episode("edge-offloading", vehicle, start - early, end - early, WITHIN_S))
            found.append(Episode("in-the-cloud", vehicle, max(begin - early, 0.0), start - early, WITHIN_S))
            begin = end
        found.append(Episode("in-the-cloud", vehicle, max(begin - early, 0.0), None, WITHIN_S))
    return found


def place(vehicle: str, t: float) -> str:
    """The expected place of the vehicle's application."""
    return "edge" if any(start <= t < (end or DURATION_S) for start, end in edge_times(vehicle)) else "cloud"


def moment(at_s: float) -> Moment:
    """The expected applications at a time that is more than a second from any change."""
    runs = {
        f"vision/{vehicle}-{place(vehicle, at_s)}": {"answers": f"vehicles/{vehicle}/vision/{place(vehicle, at_s)}"}
        for vehicle in TRUTH
    }
    return Moment(at_s, runs)


def check(played: Played) -> Iterator[str]:
    """From its first moment on, each vehicle is wanted in exactly one place: what the one ends, the other begins."""
    for vehicle in TRUTH:
        changes = [
            (seconds(event.time), event.episode.rule, event.started)
            for event in played.events
            if event.episode.subject == vehicle
        ]
        for at in sorted({each[0] for each in changes}):
            wanted = sum(1 if started else -1 for when, _, started in changes if when <= at)
            if wanted != 1:
                yield f"at {at:g} s {vehicle} is wanted in {wanted} places; expected: in one"


def picture(seed: int, due: Sequence[Episode]) -> str:
    """The measured values, and the place of the application."""
    chart = Chart(DURATION_S)
    curves = []
    for number, vehicle in enumerate(TRUTH):
        rng = np.random.default_rng([seed, number])
        times = [index / 10 for index in range(DURATION_S * 10)]
        points = [(t, 1000 * (round_trip(vehicle, t) + JITTER_S * rng.standard_normal())) for t in times]
        curves.append((vehicle, points[::2]))
    chart.curves("milliseconds to the cloud and back", curves, 0, 160, ("too long", 1000 * TOO_LONG_S))
    for rule, title, colour in (
        ("in-the-cloud", "in the cloud", "#b9c4cf"), ("edge-offloading", "at the edge", "#1b6ca8"),
    ):  # fmt: skip
        rows = [
            (vehicle, [(each.start_s, each.end_s or DURATION_S, "") for each in due
                       if (each.rule, each.subject) == (rule, vehicle)])
            for vehicle in TRUTH
        ]  # fmt: skip
        chart.bars(title, rows, colour)
    return chart.svg()
