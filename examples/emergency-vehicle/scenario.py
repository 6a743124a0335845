"""An ambulance in operation, two that are in no hurry, a road sweeper, and five cars on and near the route.

The truth is where everybody drives, and the operation. Who is on the route follows from the distance to its roads; the
control centre receives a polygon around them instead.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cache

import numpy as np
from its_stations import Place, cam, denm

from examples.running.drawing import Chart
from examples.running.scenario import SECOND, START_NS, Episode, Message, Moment, Scenario, as_json

SEED = 5
DURATION_S = 75
BEGINS_S, OVER_S = 10.0, 63.0
"""The operation."""
LIGHT_BAR_S, LIT_S = 13.0, 3.0
"""When the ambulance switches its light bar on, and how long it must have been."""
EARLIER_OVER_S = 3.0
"""The end of another operation."""
LASTING_S = 4.0
"""A car that is on the route for a shorter time only crosses it."""
HALF_WIDTH = 12.0
LENGTH, HEIGHT = 800.0, 600.0
ROADS = ("Ring", "Station Street")
"""From (0, 0) east to (800, 0), from there north to (800, 600); metres."""
ORIGIN: Place = (50.7760, 6.0840)
CAR, SPECIAL = 5, 10
"""Station types."""

_W = HALF_WIDTH
Corners = Sequence[tuple[float, float]]
"""Metres east and north."""
_ROUTE: Corners = (
    (-_W, -_W), (LENGTH + _W, -_W), (LENGTH + _W, HEIGHT + _W), (LENGTH - _W, HEIGHT + _W), (LENGTH - _W, _W), (-_W, _W)
)  # fmt: skip
_STREET: Corners = ((LENGTH - _W, -_W), (LENGTH + _W, -_W), (LENGTH + _W, HEIGHT + _W), (LENGTH - _W, HEIGHT + _W))

Way = Sequence[tuple[float, float, float]]
"""Seconds, and metres east and north; straight and steady in between."""

AMBULANCE, TRANSPORT, RETURNING, SWEEPER = 101, 102, 103, 104
WAYS: dict[int, Way] = {
    AMBULANCE: [(0, 0, 0), (10, 0, 0), (40, LENGTH, 0), (63, LENGTH, HEIGHT)],
    TRANSPORT: [(0, 0, 60), (75, 700, 60)],  # an operation without urgency: no light bar
    RETURNING: [(0, 300, 200), (75, 300, 900)],  # its light bar is on, but its operation in Station Street is over
    SWEEPER: [(0, 500, 3)],  # works on the route, and has no navigation
    201: [(0, 100, -3), (29, 420, -3), (49, 420, -200)],  # ahead of the ambulance, and turns off
    202: [(0, 100, 62), (75, 700, 62)],  # on the parallel road, on the way of the transport
    203: [(0, 600, -200), (20, 600, -200), (50, 600, 200)],  # crosses the route
    204: [(0, 1000, 300), (22, 1000, 300), (42, 803, 300), (63, 803, 500)],  # comes onto it
    205: [(0, 797, 450)],  # waits on it
}
CARS = [station for station in WAYS if station > SWEEPER]


def scenario(seed: int = SEED) -> Scenario:
    """A little more than a minute."""
    due = episodes()
    return Scenario(
        title="Emergency vehicle prioritisation",
        seed=seed,
        messages=lambda: messages(seed),
        episodes=due,
        actions={"emergency-vehicle/navigation": 3, "car-connected/navigation": len(CARS)},
        moments=[moment(at) for at in (7.0, 26.0, 37.0, 56.0, 72.0)],
        real_time=True,  # a CAM contains its time modulo 65 s
        picture=lambda: picture(due),
    )


def messages(seed: int) -> Iterator[Message]:
    """Two CAM a second from each vehicle, a DENM a second from the ambulance, and the rescue service's messages."""
    for station in WAYS:
        rng = np.random.default_rng([seed, station])
        phase = int(rng.integers(0, SECOND // 2))
        for number in range(2 * DURATION_S):
            after = phase + number * SECOND // 2
            t = after / SECOND
            special = station not in CARS
            light = (station == AMBULANCE and t >= LIGHT_BAR_S) or station == RETURNING if special else None
            where = _place(*(_at(station, t) + rng.normal(0, 0.3, 2)))
            kind = SPECIAL if special else CAR
            yield Message(
                after,
                "etsi/cam",
                cam(station, kind, (START_NS + after) / 1e9, where, _speed(station, t), light),
                "uper",
            )
    for second in range(round(BEGINS_S), round(OVER_S) + 1):
        after = second * SECOND
        warning = denm(
            AMBULANCE, (START_NS + after) / 1e9, _place(*_at(AMBULANCE, second)), cancels=second == round(OVER_S)
        )
        yield Message(after, "etsi/denm", warning, "uper")
    for second in range(round(EARLIER_OVER_S) + 1):
        after = second * SECOND + SECOND // 4
        over = second == round(EARLIER_OVER_S)
        warning = denm(RETURNING, (START_NS + after) / 1e9, _place(*_at(RETURNING, second)), cancels=over)
        yield Message(after, "etsi/denm", warning, "uper")
    yield _operation(1, RETURNING, ROADS[1:], _STREET)
    yield _operation(8, TRANSPORT, ["Parallel Road"], ((-10, 50), (710, 50), (710, 72), (-10, 72)))
    yield _operation(round(BEGINS_S), AMBULANCE, ROADS, _ROUTE)


def _operation(second: int, station: int, roads: Sequence[str], corners: Corners) -> Message:
    """The rescue service's messages: the vehicles in operation, and a polygon around the route."""
    corridor = [list(_place(*corner)) for corner in corners]
    content = {"station": station, "roads": list(roads), "corridor": corridor}
    return Message(second * SECOND, "center/operations", as_json(content))


def on_route(x: float, y: float) -> bool:
    """Whether it is on one of the operation's roads, or at most half their width beside."""
    on_ring = abs(y) <= HALF_WIDTH and -HALF_WIDTH <= x <= LENGTH + HALF_WIDTH
    on_station_street = abs(x - LENGTH) <= HALF_WIDTH and -HALF_WIDTH <= y <= HEIGHT + HALF_WIDTH
    return on_ring or on_station_street


@cache
def spans() -> dict[int, tuple[float, float]]:
    """From when to when a car is on the route while the ambulance is in a hurry; of who is there long enough."""
    found = {}
    for car in CARS:
        times = [float(t) for t in np.arange(LIGHT_BAR_S + LIT_S, OVER_S, 0.05) if on_route(*_at(car, t))]
        if times and times[-1] - times[0] > LASTING_S:
            found[car] = (times[0], times[-1] + 0.05)
    return found


def episodes() -> list[Episode]:
    """Vehicles on the route for four seconds are warned, until they have left it or the operation is over."""
    reported = [
        Episode("emergency-vehicle", f"its-{AMBULANCE}+its-{car}", start + LASTING_S, end, 1.5)
        for car, (start, end) in spans().items()
    ]
    return reported + [Episode("car-connected", f"its-{car}", 0.0, None) for car in CARS]


def moment(at_s: float) -> Moment:
    """The area that each car's navigation avoids, at a time without a change nearby."""
    avoiding = [car for car, (start, end) in spans().items() if start <= at_s < end]
    return Moment(
        at_s,
        {
            f"navigation/its-{car}": {"vehicle": f"its-{car}", "avoid": sorted(ROADS) if car in avoiding else []}
            for car in CARS
        },
    )


def picture(due: list[Episode]) -> str:
    """The vehicles' distances from the route, and the warnings."""
    chart = Chart(DURATION_S)
    times = [float(t) for t in np.arange(0, DURATION_S, 1.0)]
    chart.curves(
        "metres from the route",
        [(f"car {car}", [(t, _from_route(*_at(car, t))) for t in times]) for car in CARS],
        0, 200, ("on the route", HALF_WIDTH),
    )  # fmt: skip
    chart.bars(
        "the ambulance", [("operation", [(BEGINS_S, OVER_S, "")]), ("light bar", [(LIGHT_BAR_S, DURATION_S, "")])]
    )
    reported = {each.subject: each for each in due if each.rule == "emergency-vehicle"}
    rows = []
    for car in CARS:
        each = reported.get(f"its-{AMBULANCE}+its-{car}")
        rows.append((f"car {car}", [(each.start_s, each.end_s or DURATION_S, "Ring, Station Street")] if each else []))
    chart.bars("navigation avoids", rows, "#d1495b")
    return chart.svg()


def _from_route(x: float, y: float) -> float:
    ring = math.hypot(x - min(max(x, 0.0), LENGTH), y)
    return min(ring, math.hypot(x - LENGTH, y - min(max(y, 0.0), HEIGHT)))


def _at(station: int, t: float) -> np.ndarray:
    times, east, north = zip(*WAYS[station], strict=True)
    return np.array([np.interp(t, times, east), np.interp(t, times, north)])


def _speed(station: int, t: float) -> float:
    return float(np.hypot(*(_at(station, t + 0.25) - _at(station, t - 0.25))) / 0.5)


def _place(east: float, north: float) -> Place:
    """Degrees; within a kilometre the Earth is flat enough."""
    latitude, longitude = ORIGIN
    return latitude + north / 111_240.0, longitude + east / (111_320.0 * math.cos(math.radians(latitude)))
