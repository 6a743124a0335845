"""Three shuttles in the spray of a wet road. One slows down in time, one cannot, one drives elsewhere.

The truth is how far each perception sees and how fast each shuttle goes, over time; and when a person releases one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from examples.running.drawing import Chart
from examples.running.playing import Played
from examples.running.scenario import SECOND, START_NS, Episode, Message, Moment, Scenario, as_json

SEED = 8
DURATION_S = 56
PERIOD_NS = SECOND // 10
STEP_S = 0.01
WITHIN_S = 0.6
"""Samples come every 0.1 s, the rules look every 0.2 s, and what is seen is noisy."""
REACTION_S, BRAKING = 1.0, 3.0
LASTING_S, NOT_CONTROLLED_S = 0.5, 4.0
FULL_SPEED, SLOW = 13.9, 8.0
RELEASED_S = 45.0

Curve = Sequence[tuple[float, float]]
"""Seconds and values, with straight lines between."""


@dataclass(frozen=True, slots=True)
class Shuttle:
    """The range of its perception in metres, and its speed in m/s."""

    seen: Curve
    speed: Curve

    def seen_at(self, t: float) -> float:
        """Metres."""
        return _value(self.seen, t)

    def speed_at(self, t: float) -> float:
        """In m/s."""
        return _value(self.speed, t)

    def stops_within(self, t: float) -> float:
        """Metres that it needs to come to rest."""
        return self.speed_at(t) * REACTION_S + self.speed_at(t) ** 2 / (2 * BRAKING)


def _value(curve: Curve, t: float) -> float:
    return float(np.interp(t, [at for at, _ in curve], [value for _, value in curve]))


SHUTTLES = {
    # The spray of a lorry; it slows down on request, and all is well.
    "shuttle-1": Shuttle([(10, 80), (12, 35), (22, 35), (24, 80)], [(13.4, 13), (15.4, 10), (24, 10), (26, 13)]),
    # The same, but it goes downhill on wet leaves and does not get slower; the safe stop brings it to rest.
    "shuttle-2": Shuttle([(14, 80), (16, 35), (48, 35), (50, 80)], [(21.5, 13), (26, 0), (46, 0), (49, 6)]),
    # Elsewhere, in the sun.
    "shuttle-3": Shuttle([(0, 80), (DURATION_S, 80)], [(0, 13), (DURATION_S, 13)]),
}


def scenario(seed: int = SEED) -> Scenario:
    """Not quite a minute."""
    due = episodes()
    return Scenario(
        title="Safe state on an uncontrollable insufficiency",
        seed=seed,
        messages=lambda: messages(seed),
        episodes=due,
        actions={
            "insufficiency/slower": 2, "safe-state/stop": 1, "safe-state/no-driving": 1, "safe-state/control-room": 1,
            "shuttle-drives/driving": 3,
        },
        moments=[moment(at, due) for at in (8.0, 13.9, 16.0, 19.5, 30.0, 43.0, 52.0)],
        picture=lambda: picture(due),
        check=check,
    )  # fmt: skip


def messages(seed: int) -> Iterator[Message]:
    """The range and speed of each shuttle, ten times a second, and the operator's release."""
    for number, (name, shuttle) in enumerate(SHUTTLES.items()):
        rng = np.random.default_rng([seed, number])
        for index in range(DURATION_S * SECOND // PERIOD_NS):
            after = index * PERIOD_NS + (number + 1) * SECOND // 50
            t, stamp = after / SECOND, (START_NS + after) / SECOND
            seen = {"stamp": stamp, "range": shuttle.seen_at(t) + 0.3 * rng.standard_normal()}
            yield Message(after, f"vehicles/{name}/perception/quality", as_json(seen))
            yield Message(after, f"vehicles/{name}/odometry", as_json({"stamp": stamp, "speed": shuttle.speed_at(t)}))
    after = round(RELEASED_S * SECOND)
    content = {"stamp": (START_NS + after) / SECOND, "released": True}
    yield Message(after, "vehicles/shuttle-2/operator", as_json(content))


def episodes() -> list[Episode]:
    """From the truth: too fast for half a second; that for four seconds more; until a person releases it."""
    found = [Episode("shuttle-drives", name, 0.0) for name in SHUTTLES]
    for name, shuttle in SHUTTLES.items():
        onset: float | None = None
        start: float | None = None
        for step in range(100, round(DURATION_S / STEP_S)):
            t = step * STEP_S
            seen = np.mean([shuttle.seen_at(each) for each in np.arange(t - 1, t, 0.1)])
            if start is None:
                onset = (t if onset is None else onset) if shuttle.stops_within(t) > seen else None
                start = t if onset is not None and t - onset >= LASTING_S else None
            elif shuttle.stops_within(t) < 0.9 * seen:
                found.append(Episode("insufficiency", name, start - 0.1, t - 0.1, WITHIN_S))
                if t - start > NOT_CONTROLLED_S:
                    safe = start + NOT_CONTROLLED_S
                    found.append(Episode("safe-state", name, safe - 0.1, RELEASED_S, WITHIN_S + 0.2))
                break
    return found


def moment(at_s: float, due: Sequence[Episode]) -> Moment:
    """The expected applications at a time that is more than a second from any change."""
    now = {(each.rule, each.subject) for each in due if each.start_s <= at_s < (each.end_s or DURATION_S)}
    runs: dict[str, dict[str, object]] = {}
    for name in SHUTTLES:
        limit = SLOW if ("insufficiency", name) in now else FULL_SPEED
        runs[f"automated-driving/{name}"] = {"vehicle": name, "maxSpeed": limit}
        if ("safe-state", name) in now:
            runs[f"safe-stop/{name}"] = {"vehicle": name}
    suspended = [f"automated-driving/{name}" for name in SHUTTLES if ("safe-state", name) in now]
    return Moment(at_s, runs, suspended)


def check(played: Played) -> Iterator[str]:
    """The control room received the safe stop of the one shuttle, and its end."""
    reported = [(each.content["subject"], each.content["type"].rpartition(".")[2]) for each in played.notices]
    if reported != [("shuttle-2", "started"), ("shuttle-2", "ended")]:
        yield f"the control room received {reported}; expected: that shuttle-2 stops, and that it continues"


def picture(due: Sequence[Episode]) -> str:
    """The visible range, the stopping distance, and the results."""
    chart = Chart(DURATION_S)
    times = [each / 4 for each in range(DURATION_S * 4)]
    for name in ("shuttle-1", "shuttle-2"):
        shuttle = SHUTTLES[name]
        curves = [("sees", [(t, shuttle.seen_at(t)) for t in times]),
                  ("stops within", [(t, shuttle.stops_within(t)) for t in times])]  # fmt: skip
        chart.curves(f"metres, {name}", curves, 0, 90)
    for rule, title, colour in (
        ("insufficiency", "insufficient: drives slower", "#e08e45"),
        ("safe-state", "safe state: driving suspended, safe stop runs", "#d1495b"),
    ):
        rows = [(each.subject, [(each.start_s, each.end_s or DURATION_S, "")]) for each in due if each.rule == rule]
        chart.bars(title, rows, colour)
    return chart.svg()
