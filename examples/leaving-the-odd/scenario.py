"""Five cars on a highway; three of them must receive a take-over request, each for another reason.

The truth is where each car is and goes: its speed over time, its route, and when its driver takes over.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from examples.running.drawing import Chart
from examples.running.playing import Played, seconds
from examples.running.scenario import SECOND, START_NS, Episode, Message, Scenario, as_json

Value = TypeVar("Value")

SEED = 0
DURATION_S = 180
PERIOD_S = 0.2
LEAD_S, LEAST_M = 40.0, 500.0
STEP_S = 0.01


@dataclass(frozen=True, slots=True)
class Car:
    """A car's drive along the highway.

    Attributes:
        speeds: m/s from each second on.
        routes: from each second on, the manoeuvres ahead: kind and metres from where the drive begins.
        automated: from second, to second, in which it drives by itself.
    """

    speeds: Mapping[float, float]
    routes: Mapping[float, Sequence[tuple[str, float]]]
    automated: tuple[float, float]

    def speed(self, t: float) -> float:
        """In m/s."""
        return _latest(self.speeds, t)

    def at(self, t: float) -> float:
        """Metres from where the drive begins."""
        begins = sorted(self.speeds)
        ends = [*begins[1:], math.inf]
        return sum(self.speeds[b] * max(0.0, min(t, e) - b) for b, e in zip(begins, ends, strict=True))

    def to_exit(self, t: float) -> float:
        """Metres to the next exit of its route; infinite where it takes none."""
        ahead = [at - self.at(t) for kind, at in _latest(self.routes, t) if kind == "Exit"]
        return min((metres for metres in ahead if metres > 0), default=math.inf)

    def is_automated(self, t: float) -> bool:
        """Whether the car drives by itself."""
        return self.automated[0] <= t < self.automated[1]


CARS = {
    # Takes the second exit; its driver takes over eight seconds after the request.
    "car-1": Car({0: 33.0}, {0: [("Pass", 1800.0), ("Exit", 4600.0)]}, (0, 107.4)),
    # Stays on the highway.
    "car-2": Car({0: 31.0}, {0: [("Pass", 1800.0), ("Pass", 4600.0)]}, (0, math.inf)),
    # Takes an exit, but a person drives.
    "car-3": Car({0: 36.0}, {0: [("Exit", 1800.0)]}, (math.inf, math.inf)),
    # Finds a jam ahead: from second 70 on the route leaves the highway only 900 m further.
    "car-4": Car({0: 30.0}, {0: [("Pass", 1800.0), ("Pass", 3000.0)], 70: [("Exit", 3000.0)]}, (0, 79.1)),
    # Is in the jam: at 6 m/s, forty seconds are 240 m, so the 500 m count. At first it goes faster.
    "car-5": Car({0: 28.0, 40: 6.0}, {0: [("Exit", 2050.0)]}, (0, 135.3)),
}


def _latest(values: Mapping[float, Value], t: float) -> Value:
    """The state that counts from the last whole second on."""
    begins = sorted(values)
    return values[begins[bisect_right(begins, t) - 1]]


def scenario(seed: int = SEED) -> Scenario:
    """Three minutes; nothing in them is random."""
    due = episodes()
    return Scenario(
        title="Level 3 request to intervene",
        seed=seed,
        messages=messages,
        episodes=due,
        actions={"leaving-the-odd/driver": len(due)},
        picture=lambda: picture(due),
        check=check,
    )


def messages() -> Iterator[Message]:
    """Each car sends its route when it changes, and its position on it five times a second."""
    for number, (name, car) in enumerate(CARS.items()):
        for begin, route in car.routes.items():
            after = round(begin * SECOND)
            manoeuvres = [{"kind": kind, "at": at} for kind, at in route]
            content = {"stamp": (START_NS + after) / SECOND, "manoeuvres": manoeuvres}
            yield Message(after, f"vehicles/{name}/route", as_json(content))
        for index in range(round(DURATION_S / PERIOD_S)):
            after = index * round(PERIOD_S * SECOND) + (number + 1) * SECOND // 50
            t = after / SECOND
            content = {
                "stamp": (START_NS + after) / SECOND,
                "at": car.at(t),
                "speed": car.speed(t),
                "automation": "Level3" if car.is_automated(t) else "Manual",
            }
            yield Message(after, f"vehicles/{name}/progress", as_json(content))


def episodes() -> list[Episode]:
    """From the truth: requested once the exit is nearer than both leads allow, until the driver has taken over."""
    found = []
    for name, car in CARS.items():
        for step in range(round(DURATION_S / STEP_S)):
            t = step * STEP_S
            if car.is_automated(t) and car.to_exit(t) < max(LEAST_M, LEAD_S * car.speed(t)):
                found.append(Episode("leaving-the-odd", name, t - STEP_S, car.automated[1], PERIOD_S + STEP_S))
                break
    return found


def check(played: Played) -> Iterator[str]:
    """Each driver received the distance, and each display the end."""
    starts = {event.episode.subject: seconds(event.episode.start_time) for event in played.events if event.started}
    reported: dict[str, list[str]] = {}
    for notice in played.notices:
        vehicle, kind = notice.content["subject"], notice.content["type"].rpartition(".")[2]
        reported.setdefault(vehicle, []).append(kind)
        distance = float(notice.content["data"]["notification"]["labels"]["distance"])
        truth = CARS[vehicle].to_exit(starts[vehicle])
        if not abs(distance - truth) < 0.01:
            yield f"the driver of {vehicle} received a distance of {distance} m to the exit; it is {truth:.2f} m"
    for vehicle in starts:
        if reported.get(vehicle) != ["started", "ended"]:
            yield f"the driver of {vehicle} received {reported.get(vehicle)}; expected: started, ended"


def picture(due: list[Episode]) -> str:
    """The distance to each car's exit, and the take-over requests."""
    chart = Chart(DURATION_S)
    curves = []
    for name, car in CARS.items():
        points = [(float(t), car.to_exit(t)) for t in range(DURATION_S) if math.isfinite(car.to_exit(t))]
        curves.append((name, points))
    chart.curves("metres to the next exit on the route", [each for each in curves if each[1]], 0, 4600)
    chart.bars("drives by itself", [(name, [_span(car)] if car.automated[0] < DURATION_S else [])
                                    for name, car in CARS.items()], "#b9c4cf")  # fmt: skip
    chart.bars("request to intervene", [(each.subject, [(each.start_s, each.end_s or DURATION_S, "")])
                                        for each in due], "#d1495b")  # fmt: skip
    return chart.svg()


def _span(car: Car) -> tuple[float, float, str]:
    return car.automated[0], min(car.automated[1], DURATION_S), ""
