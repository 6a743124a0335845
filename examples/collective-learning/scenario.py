"""Three vehicles at a crossroads; each sees the same things from its own side, and some are wrong now and then.

The truth is where vehicles and things are, and who overlooks or imagines what, and when.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from examples.running.drawing import Chart
from examples.running.playing import Played, seconds
from examples.running.recording import missing_messages, read_recording, within
from examples.running.ros import cloud, header, make, ros_message
from examples.running.scenario import SECOND, START_NS, Episode, Message, Scenario, as_json

SEED = 5
DURATION_S = 30
PERIOD_NS = SECOND // 10
LATENCY_NS = 50_000_000
REACH_M = 130.0
SCENE_M = 60.0
"""The scene is the square of this number of metres to each side of the crossroads' centre."""
NOISE_M = 0.15
PERSIST_S = 1.0
BEFORE_S, AFTER_S = 3.0, 2.0
POSE = "geometry_msgs/msg/PoseStamped"


@dataclass(frozen=True, slots=True)
class StreetObject:
    """Something that stands or moves straight on: metres at second 0, and m/s."""

    name: str
    x: float
    y: float
    vx: float = 0.0
    vy: float = 0.0

    def at(self, t: float) -> tuple[float, float]:
        """The position at that time."""
        return self.x + self.vx * t, self.y + self.vy * t

    def in_scene(self, t: float) -> bool:
        """Whether it is at the crossroads."""
        return all(abs(each) <= SCENE_M for each in self.at(t))


@dataclass(frozen=True, slots=True)
class Error:
    """A vehicle overlooks a thing, or imagines it, from one second to another."""

    vehicle: str
    thing: str
    start_s: float
    end_s: float


VEHICLES = {
    StreetObject("car-1", -80.0, -2.0, 8.0, 0.0): 0.0,
    StreetObject("car-2", 2.0, -90.0, 0.0, 6.0): math.pi / 2,
    StreetObject("car-3", 18.0, -16.0): 2.3,  # parked
    StreetObject("car-4", -400.0, -2.0): 0.0,  # far away, and sees nothing of all this
}
"""Each with its heading in radians."""
THINGS = (
    StreetObject("pedestrian", 8.0, 7.0),
    StreetObject("cyclist", -20.0, 12.0, 2.0, 0.0),
    StreetObject("truck", -14.0, -14.0),
    StreetObject("tractor", 95.0, 30.0),  # not at the scene
)
GHOST = StreetObject("ghost", -6.0, 24.0)
TRUTH = (
    Error("car-1", "pedestrian", 7.0, 11.0),
    Error("car-2", "truck", 11.5, 12.1),  # too short to matter
    Error("car-2", "ghost", 13.0, 16.5),
    Error("car-2", "tractor", 8.0, 20.0),  # not at the scene: vehicles there need not see it
    Error("car-1", "cyclist", 20.0, 24.0),  # has left the scene by then
)


def scenario(seed: int = SEED) -> Scenario:
    """Half a minute."""
    due = episodes()
    return Scenario(
        title="Multi-perspective label generation",
        seed=seed,
        messages=lambda: messages(seed),
        episodes=due,
        actions={"collective-learning/perspectives": len(due)},
        picture=lambda: picture(due),
        check=lambda played: check(played, list(messages(seed))),
    )


def messages(seed: int) -> Iterator[Message]:
    """Each vehicle sends its pose and its objects ten times a second, and its point cloud five times."""
    for number, (vehicle, heading) in enumerate(VEHICLES.items()):
        rng = np.random.default_rng([seed, number])
        for index in range(DURATION_S * SECOND // PERIOD_NS):
            after = index * PERIOD_NS + (number + 1) * SECOND // 100
            t = after / SECOND
            x, y = vehicle.at(t)
            position = make("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
            turn = make(
                "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(heading / 2), w=math.cos(heading / 2)
            )  # fmt: skip
            pose = make(
                POSE,
                header=header(after, "map"),
                pose=make("geometry_msgs/msg/Pose", position=position, orientation=turn),
            )
            yield ros_message(after, f"vehicles/{vehicle.name}/pose", POSE, pose)
            seen = {each.name: _from(vehicle, heading, each, t) for each in _listed(vehicle, t)}
            objects = [
                {"class": name.partition("-")[0], "x": place[0] + NOISE_M * rng.standard_normal(),
                 "y": place[1] + NOISE_M * rng.standard_normal()}
                for name, place in seen.items()
            ]  # fmt: skip
            content = {"stamp": (START_NS + after) / SECOND, "objects": objects}
            yield Message(after + LATENCY_NS, f"vehicles/{vehicle.name}/objects", as_json(content))
            if index % 2 == 0:
                centres = [np.array([*_from(vehicle, heading, each, t), -0.8]) for each in _near(vehicle, t)]
                ground = rng.normal(0, 15, (150, 3)) * np.array([1, 1, 0]) - np.array([0, 0, 1.7])
                points = np.vstack([ground, *(each + rng.normal(0, 0.4, (25, 3)) for each in centres)])
                points = np.column_stack([points, rng.uniform(0, 1, len(points))])
                sent = cloud(after, f"vehicles/{vehicle.name}/points", "lidar", points)
                yield replace(sent, after_ns=after + LATENCY_NS // 2)


def _from(vehicle: StreetObject, heading: float, thing: StreetObject, t: float) -> tuple[float, float]:
    """The position of the object relative to the vehicle: metres ahead and to the left."""
    (x, y), (vx, vy) = thing.at(t), vehicle.at(t)
    cosine, sine = math.cos(heading), math.sin(heading)
    return cosine * (x - vx) + sine * (y - vy), -sine * (x - vx) + cosine * (y - vy)


def _near(vehicle: StreetObject, t: float) -> list[StreetObject]:
    """The visible objects, including other vehicles."""
    others = [each for each in VEHICLES if each is not vehicle]
    return [each for each in (*THINGS, *others) if math.dist(each.at(t), vehicle.at(t)) < REACH_M]


def _listed(vehicle: StreetObject, t: float) -> list[StreetObject]:
    """The vehicle's list of objects."""
    wrong = {each.thing for each in TRUTH if each.vehicle == vehicle.name and each.start_s <= t < each.end_s}
    return [each for each in _near(vehicle, t) if each.name not in wrong] + [GHOST] * (GHOST.name in wrong)


def episodes() -> list[Episode]:
    """A pair conflicts where one of the two is wrong for a second about something at the scene, and both are there."""
    at_scene = {each.name: each for each in (*THINGS, GHOST)}
    found = []
    for a, b in itertools.combinations(sorted(VEHICLES, key=lambda each: each.name), 2):
        for error in TRUTH:
            times = (error.start_s, error.start_s + PERSIST_S)
            there = all(each.in_scene(t) for each in (a, b, at_scene[error.thing]) for t in times)
            if error.vehicle in (a.name, b.name) and there and error.end_s - error.start_s > PERSIST_S:
                found.append(
                    Episode("collective-learning", f"{a.name}+{b.name}", times[1], error.end_s, 0.7)
                )  # fmt: skip
    return found


def check(played: Played, sent: list[Message]) -> Iterator[str]:
    """Each recording holds what both vehicles sent, from three seconds before until two seconds after."""
    ended = {(event.episode.subject, event.episode.start_time): event for event in played.events if not event.started}
    folders = played.recordings("collective-learning")
    for (subject, start), event in sorted(ended.items(), key=lambda each: each[1].episode.start_time):
        first, last = seconds(event.episode.onset_time) - BEFORE_S, seconds(event.end_time or 0) + AFTER_S
        recorded = [each for each in folders if event.episode.id in each.name]
        if len(recorded) != 1:
            yield f"{subject} from {seconds(start):g} s on: {len(recorded)} recordings; expected: one"
            continue
        must = within(sent, subject.split("+"), first, last)
        yield from missing_messages(must, read_recording(recorded[0]), f"the recording of {subject}")


def picture(due: list[Episode]) -> str:
    """The distances from the crossroads, the errors over time, and the recordings."""
    chart = Chart(DURATION_S)
    curves = [
        (each.name, [(t / 2, math.hypot(*each.at(t / 2))) for t in range(DURATION_S * 2)])
        for each in VEHICLES if each.name != "car-4"
    ]  # fmt: skip
    chart.curves("metres from the crossroads' middle", curves, 0, 100, ("the scene", SCENE_M))
    rows = [(f"{each.vehicle}: {each.thing}", [(each.start_s, each.end_s, "")]) for each in TRUTH]
    chart.bars("overlooks, or imagines", rows, "#8e5ea2")
    subjects = dict.fromkeys(each.subject for each in due)
    spans = [
        (subject.replace("+", " and "), [(each.start_s - BEFORE_S, (each.end_s or DURATION_S) + AFTER_S, "")
                                         for each in due if each.subject == subject])
        for subject in subjects
    ]  # fmt: skip
    chart.bars("recorded from both sides", spans, "#d1495b")
    return chart.svg()
