"""A vehicle drives down a street; its perception overlooks things, or mistakes them, and mostly knows better later.

The truth is what stands and moves in the street, and what the perception makes of it when. It lists ten times a second
what it follows: as what, how sure it is, and for how long it has not seen it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from examples.running.drawing import Chart
from examples.running.playing import Played, seconds
from examples.running.recording import missing_messages, read_recording, within
from examples.running.ros import cloud, header, make, ros_message
from examples.running.scenario import SECOND, START_NS, Episode, Message, Scenario, as_json

SEED = 26
DURATION_S = 44
PERIOD_NS = SECOND // 10
LATENCY_NS = 50_000_000
STEP_S = 0.01
EGO_SPEED = 10.0
AHEAD, BEHIND = 60.0, 15.0
"""The range of the vehicle's perception, in metres."""
SURE_M = 40.0
"""The range within which perception is certain, in metres."""
GIVEN_UP_S = 3.0
"""An object that the tracker has not seen for this time leaves its list; seen again, it has a new number."""
MISSED_S, LOOKS_BACK_S = 1.0, 6.0
NOISE_M = 0.15
BEFORE_S, AFTER_S = 6.0, 2.0
WITHIN_S = 0.3
POSE = "geometry_msgs/msg/PoseStamped"


@dataclass(frozen=True, slots=True)
class StreetObject:
    """Something in the street: what it is, where at second 0, in metres along and across, and its speed along."""

    number: int
    name: str
    x: float
    y: float
    speed: float = 0.0

    def ahead(self, t: float) -> float | None:
        """The distance ahead of the vehicle in metres; None if out of range."""
        found = self.x + (self.speed - EGO_SPEED) * t
        return found if -BEHIND <= found <= AHEAD else None

    def is_sure(self, t: float) -> bool:
        """Whether it is near enough for the perception to be sure of it."""
        there = self.ahead(t)
        return there is not None and there <= SURE_M


@dataclass(frozen=True, slots=True)
class Error:
    """An error about an object from one second to another: it is misclassified, or overlooked."""

    thing: str
    start_s: float
    end_s: float
    mistaken_for: str = ""
    """Overlooked where empty."""


THINGS = (
    StreetObject(1, "van", 70.0, 3.0),
    StreetObject(2, "cyclist", 60.0, -3.0, 5.0),
    StreetObject(3, "pedestrian", 150.0, 4.5),
    StreetObject(4, "oncoming car", 300.0, -3.5, -12.0),
    StreetObject(5, "bus", 260.0, 3.5),
    StreetObject(6, "child", 300.0, 5.0),
    StreetObject(7, "car ahead", 25.0, 0.0, EGO_SPEED),
)
TRUTH = (
    Error("van", 0.0, 2.6, "car"),  # known before the perception is sure of it
    Error("cyclist", 6.0, 6.5),  # bridged by the tracker
    Error("pedestrian", 12.0, 14.0),
    Error("bus", 0.0, DURATION_S, "truck"),  # never known
    Error("child", 26.5, 30.0),  # given up in between
    Error("car ahead", 33.0, 35.0),
)


def scenario(seed: int = SEED) -> Scenario:
    """Three quarters of a minute."""
    due = [episode for episode, _ in known_better()]
    return Scenario(
        title="Multi-timestep label generation",
        seed=seed,
        messages=lambda: messages(seed),
        episodes=due,
        actions={"multi-timestep-labels/timesteps": len(due)},
        picture=lambda: picture(due),
        check=lambda played: check(played, list(messages(seed))),
    )


def messages(seed: int) -> Iterator[Message]:
    """The vehicle's pose, its point clouds, and what its perception makes of them."""
    rng = np.random.default_rng(seed)
    for index in range(DURATION_S * SECOND // PERIOD_NS):
        after = index * PERIOD_NS + SECOND // 100
        t = after / SECOND
        place = make(
            "geometry_msgs/msg/Pose",
            position=make("geometry_msgs/msg/Point", x=EGO_SPEED * t, y=0.0, z=0.0),
            orientation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        )
        pose = make(POSE, header=header(after, "map"), pose=place)
        yield ros_message(after, "vehicles/ego/pose", POSE, pose)
        points = cloud(after, "vehicles/ego/lidar/points", "lidar", _points(rng, t))
        yield replace(points, after_ns=after + LATENCY_NS // 2)
        tracks = [track for thing in THINGS if (track := _track(rng, thing, t)) is not None]
        content = {"stamp": (START_NS + after) / SECOND, "tracks": tracks}
        yield Message(after + LATENCY_NS, "vehicles/ego/perception/tracks", as_json(content))


def _track(rng: np.random.Generator, thing: StreetObject, t: float) -> dict[str, object] | None:
    """The object's entry in the list; None if it has none."""
    ahead = thing.ahead(t)
    wrong = next((each for each in TRUTH if each.thing == thing.name and each.start_s <= t < each.end_s), None)
    overlooked = wrong is not None and not wrong.mistaken_for
    unseen = t - wrong.start_s if wrong is not None and overlooked else 0.0
    if ahead is None or unseen > GIVEN_UP_S:
        return None
    lost = any(
        each.thing == thing.name
        and not each.mistaken_for
        and each.end_s - each.start_s > GIVEN_UP_S
        and each.end_s <= t
        for each in TRUTH
    )
    return {
        "id": 100 + thing.number if lost else thing.number,
        "class": wrong.mistaken_for if wrong is not None and wrong.mistaken_for else thing.name.split()[0],
        "score": rng.uniform(0.85, 1.0) if thing.is_sure(t) else rng.uniform(0.3, 0.6),
        "unseen": unseen,
        "x": ahead + NOISE_M * rng.standard_normal(),
        "y": thing.y + NOISE_M * rng.standard_normal(),
    }


def _points(rng: np.random.Generator, t: float) -> NDArray[np.float64]:
    """The street's surface, and some points on each thing: the sensor sees what the perception overlooks."""
    bearing, distance = rng.uniform(-math.pi, math.pi, 200), rng.gamma(3.0, 8.0, 200)
    parts = [np.column_stack([distance * np.cos(bearing), distance * np.sin(bearing), np.full(200, -1.7)])]
    for thing in THINGS:
        if (ahead := thing.ahead(t)) is not None:
            parts.append(np.array([ahead, thing.y, -0.8]) + rng.normal(0, 0.4, (30, 3)))
    points = np.vstack(parts)
    return np.column_stack([points, rng.uniform(0, 1, len(points))])


def known_better() -> list[tuple[Episode, int]]:
    """When the vehicle is sure of what it overlooked or mistook a moment ago, and the number of the thing.

    From when it sees the thing as what it is, and is sure; until that error is too long ago, or the thing out of sight.
    """
    found = []
    for error in TRUTH:
        (thing,) = (each for each in THINGS if each.name == error.thing)
        lasted = error.end_s - error.start_s
        if not error.mistaken_for and not MISSED_S < lasted <= GIVEN_UP_S:
            continue
        last = error.end_s - PERIOD_NS / SECOND  # the last list that is wrong
        sure = [
            t for t in np.arange(error.end_s, min(last + LOOKS_BACK_S, DURATION_S), STEP_S) if thing.is_sure(float(t))
        ]
        if sure and thing.ahead(last) is not None:
            episode = Episode("multi-timestep-labels", "ego", float(sure[0]), float(sure[-1]), WITHIN_S)
            found.append((episode, thing.number))
    found.sort(key=lambda each: each[0].start_s)
    ends = [0.0, *(episode.end_s or DURATION_S for episode, _ in found)]
    assert all(end + WITHIN_S < each.start_s for end, (each, _) in zip(ends, found, strict=False)), "they are apart"
    return found


def check(played: Played, sent: list[Message]) -> Iterator[str]:
    """Each recording holds what the vehicle saw and made of it, before and after, and names what is known better."""
    ended = [event for event in played.events if not event.started]
    folders = played.recordings("multi-timestep-labels")
    for event, (_, number), folder in zip(
        ended, known_better(), folders, strict=False
    ):  # their number is checked already
        first, last = seconds(event.episode.onset_time) - BEFORE_S, seconds(event.end_time or 0) + AFTER_S
        yield from missing_messages(
            within(sent, ["ego"], first, last), read_recording(folder), f"the recording {folder.name}"
        )
        logged = json.loads((folder / "recording.json").read_text(encoding="utf-8"))["metadata"].get("tracks")
        if logged != [number]:
            yield f"the recording {folder.name} names the tracks {logged}; expected: {[number]}"


def picture(due: list[Episode]) -> str:
    """The objects ahead, the errors over time, and the recordings."""
    chart = Chart(DURATION_S)
    curves = []
    for thing in THINGS:
        places = [(t / 5, thing.ahead(t / 5)) for t in range(DURATION_S * 5)]
        curves.append((thing.name, [(t, ahead) for t, ahead in places if ahead is not None]))
    chart.curves("metres ahead of the vehicle", curves, -BEHIND, AHEAD, ("sure below", SURE_M))
    for mistaken, title in ((True, "misclassified"), (False, "overlooked")):
        rows = [
            (each.thing, [(max(start, each.start_s), min(end, each.end_s), each.mistaken_for)])
            for each in TRUTH
            for start, end in [_visible(each.thing)]
            if bool(each.mistaken_for) == mistaken
        ]
        chart.bars(title, rows, "#8e5ea2")
    known = [(each.start_s, each.end_s or DURATION_S, "") for each in due]
    chart.bars("sure now of what was wrong before", [("ego", known)], "#3a7d44")
    chart.bars(
        "recorded", [("ego", [(max(start - BEFORE_S, 0), end + AFTER_S, "") for start, end, _ in known])], "#d1495b"
    )
    return chart.svg()


def _visible(name: str) -> tuple[float, float]:
    (thing,) = (each for each in THINGS if each.name == name)
    times = [t / 10 for t in range(DURATION_S * 10) if thing.ahead(t / 10) is not None]
    return times[0], times[-1]
