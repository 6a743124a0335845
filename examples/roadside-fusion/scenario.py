"""Five vehicles and two intersections with roadside units; now and then several approach the same one.

The truth is how the vehicles drive: straight on, at constant speed, through an intersection's middle or past it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from examples.running.drawing import Chart
from examples.running.ros import header, make, ros_message
from examples.running.scenario import SECOND, Episode, Message, Moment, Scenario

SEED = 0
DURATION_S = 80
PERIOD_NS = SECOND // 10
STEP_S = 0.01
LATE_S = 0.4
"""A pose comes every 0.1 s, and the rule looks every 0.2 s."""
POSE = "geometry_msgs/msg/PoseStamped"
NEAR_M, THERE_M = 150.0, 30.0


@dataclass(frozen=True, slots=True)
class Vehicle:
    """Where it is at second 0, in metres, and how fast it goes, in m/s."""

    x: float
    y: float
    vx: float
    vy: float

    def away(self, site: tuple[float, float], t: float) -> float:
        """Metres from the site."""
        return math.dist((self.x + self.vx * t, self.y + self.vy * t), site)

    def takes_part(self, site: tuple[float, float], t: float) -> bool:
        """Whether it approaches the site, or is there."""
        approaches = self.away(site, t) - self.away(site, max(0.0, t - 0.9)) < -1  # of a second's poses
        return self.away(site, t) < NEAR_M and (approaches or self.away(site, t) < THERE_M)


VEHICLES = {
    "car-1": Vehicle(-300.0, 0.0, 12.0, 0.0),  # along the road, through both intersections
    "car-2": Vehicle(2.0, -220.0, 0.0, 10.0),  # across the northern one
    "car-3": Vehicle(-2.0, 310.0, 0.0, -10.0),  # likewise, from the other side
    "car-4": Vehicle(1280.0, 3.0, -10.0, 0.0),  # towards the southern one
    "car-5": Vehicle(600.0, 80.0, 0.0, 0.0),  # is parked near it
}
SITES = {"north": (0.0, 0.0), "south": (600.0, 0.0)}
UNITS = {"north": "rsu-1", "south": "rsu-2"}


def scenario(seed: int = SEED) -> Scenario:
    """Eighty seconds; nothing in them is random."""
    due = episodes()
    return Scenario(
        title="On-demand sensor fusion at the roadside unit",
        seed=seed,
        messages=messages,
        episodes=due,
        actions={"roadside-fusion/fuse": len(due)},
        moments=[moment(at) for at in (10.0, 14.5, 20.0, 26.3, 40.0, 66.0, 78.0)],
        picture=lambda: picture(due),
    )


def messages() -> Iterator[Message]:
    """Each vehicle's pose, ten times a second."""
    for number, (name, vehicle) in enumerate(VEHICLES.items()):
        heading = math.atan2(vehicle.vy, vehicle.vx)
        for index in range(DURATION_S * SECOND // PERIOD_NS):
            after = index * PERIOD_NS + (number + 1) * SECOND // 100
            t = after / SECOND
            position = make(
                "geometry_msgs/msg/Point", x=vehicle.x + vehicle.vx * t, y=vehicle.y + vehicle.vy * t, z=0.0
            )
            turn = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(heading / 2), w=math.cos(heading / 2))
            pose = make("geometry_msgs/msg/Pose", position=position, orientation=turn)
            yield ros_message(after, f"vehicles/{name}/pose", POSE, make(POSE, header=header(after, "map"), pose=pose))


def taking_part(site: str, t: float) -> list[str]:
    """The vehicles that approach the site or are there."""
    return [name for name, vehicle in VEHICLES.items() if vehicle.takes_part(SITES[site], t)]


def episodes() -> list[Episode]:
    """The times in which two vehicles or more take part at a site."""
    found = []
    for site in SITES:
        start: float | None = None
        for step in range(100, round(DURATION_S / STEP_S)):
            t = step * STEP_S
            several = len(taking_part(site, t)) >= 2
            if several and start is None:
                start = t - STEP_S
            elif not several and start is not None:
                found.append(Episode("roadside-fusion", f"~fleet~{site}", start, t - STEP_S, LATE_S))
                start = None
    return found


def moment(at_s: float) -> Moment:
    """The expected applications at a time that is more than a second from any change."""
    runs: dict[str, dict[str, object]] = {}
    for site, unit in UNITS.items():
        names = taking_part(site, at_s)
        if len(names) >= 2:
            inputs = [*(f"vehicles/{name}/points" for name in names), f"units/{unit}/points"]
            runs[f"roadside-fusion/{site}"] = {"site": site, "inputs": inputs, "output": f"units/{unit}/environment"}
    return Moment(at_s, runs)


def picture(due: list[Episode]) -> str:
    """The distances from the intersections, the participants, and the times of each fusion."""
    chart = Chart(DURATION_S)
    for site, place in SITES.items():
        curves = [
            (name, [(t / 2, away) for t in range(DURATION_S * 2) if (away := vehicle.away(place, t / 2)) <= 300])
            for name, vehicle in VEHICLES.items()
        ]
        here = [(name, points) if points else (name, [(0.0, 300.0)]) for name, points in curves]
        chart.curves(f"metres from the intersection {site}", here, 0, 300, ("near", NEAR_M))
    rows = [
        (f"{site}, {UNITS[site]}", [(each.start_s, each.end_s or DURATION_S, "+".join(
            taking_part(site, (each.start_s + (each.end_s or DURATION_S)) / 2))) for each in due
            if each.subject.endswith(site)])
        for site in SITES
    ]  # fmt: skip
    chart.bars("fusion runs, in the middle with", rows, "#3a7d44")
    return chart.svg()
