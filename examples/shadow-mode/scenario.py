"""A vehicle with two perceptions drives down a street; each of them is wrong in its own way.

The truth is what stands and moves in the street, and which of the two overlooks or imagines what, and when. Both look
at the same point clouds, ten a second; the new one takes a little longer.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from examples.running.drawing import Chart
from examples.running.playing import Played, seconds
from examples.running.recording import missing_messages, read_recording, within
from examples.running.ros import cloud
from examples.running.scenario import SECOND, START_NS, Episode, Message, Scenario, as_json

SEED = 11
DURATION_S = 40
PERIOD_NS = SECOND // 10
EGO_SPEED = 8.0
AHEAD, BEHIND = 50.0, 20.0
"""The range of the vehicle's perception, in metres."""
EXISTING, SHADOW = "perception", "shadow-perception"
LATENCY_NS = {EXISTING: 40_000_000, SHADOW: 70_000_000}
NOISE_M = 0.15
PERSIST_S = 1.0
BEFORE_S, AFTER_S = 3.0, 2.0


@dataclass(frozen=True, slots=True)
class StreetObject:
    """Something in the street: where it is at second 0, in metres along and across, and how fast it goes along."""

    name: str
    x: float
    y: float
    speed: float = 0.0

    def seen_from(self, t: float) -> tuple[float, float] | None:
        """The position relative to the vehicle; None if out of range."""
        ahead = self.x + self.speed * t - EGO_SPEED * t
        return (ahead, self.y) if -BEHIND <= ahead <= AHEAD else None


@dataclass(frozen=True, slots=True)
class Error:
    """Only one of the two has the thing in its list, from one second to another."""

    thing: str
    only: str
    start_s: float
    end_s: float


THINGS = (
    StreetObject("van", 60.0, 3.0),
    StreetObject("pedestrian", 75.0, 4.5),
    StreetObject("cyclist", 20.0, -3.0, 5.0),
    StreetObject("car ahead", 30.0, 0.0, EGO_SPEED),
    StreetObject("oncoming car", 400.0, -3.5, -9.0),
    StreetObject("second pedestrian", 240.0, 5.0),
)
GHOST = StreetObject("ghost", 190.0, 2.0)
"""A reflection: there is nothing."""
TRUTH = (
    Error("pedestrian", SHADOW, 5.0, 9.5),  # overlooked beside the van by the existing one
    Error("second pedestrian", SHADOW, 26.0, 26.5),  # half a second is not worth looking at
    Error("ghost", SHADOW, 19.0, 23.0),
    Error("car ahead", EXISTING, 30.0, 35.0),
)


def scenario(seed: int = SEED) -> Scenario:
    """Forty seconds."""
    due = episodes()
    return Scenario(
        title="Discrepancies of a perception in shadow mode",
        seed=seed,
        messages=lambda: messages(seed),
        episodes=due,
        actions={"shadow-mode/both": len(due)},
        picture=lambda: picture(due),
        check=lambda played: check(played, list(messages(seed))),
    )


def messages(seed: int) -> Iterator[Message]:
    """The point clouds, and what each perception makes of them."""
    rng = np.random.default_rng(seed)
    for index in range(DURATION_S * SECOND // PERIOD_NS):
        after = index * PERIOD_NS + SECOND // 100
        t = after / SECOND
        yield cloud(after, "vehicles/ego/lidar/points", "lidar", _points(rng, t))
        for perception, latency in LATENCY_NS.items():
            objects = [
                {"class": thing.name.split()[-1], "x": place[0] + NOISE_M * rng.standard_normal(),
                 "y": place[1] + NOISE_M * rng.standard_normal(), "score": rng.uniform(0.6, 1.0)}
                for thing in (*THINGS, GHOST)
                if (place := thing.seen_from(t)) is not None and _has(perception, thing, t)
            ]  # fmt: skip
            content = {"stamp": (START_NS + after) / SECOND, "objects": objects}
            yield Message(after + latency, f"vehicles/ego/{perception}/objects", as_json(content))


def _has(perception: str, thing: StreetObject, t: float) -> bool:
    """Whether the perception has the thing in its list."""
    error = next((each for each in TRUTH if each.thing == thing.name and each.start_s <= t < each.end_s), None)
    return thing is not GHOST if error is None else error.only == perception


def _points(rng: np.random.Generator, t: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """The street's surface, and some points on each thing."""
    bearing, distance = rng.uniform(-math.pi, math.pi, 200), rng.gamma(3.0, 8.0, 200)
    ground = np.column_stack([distance * np.cos(bearing), distance * np.sin(bearing), np.full(200, -1.7)])
    parts = [ground]
    for thing in THINGS:
        if (place := thing.seen_from(t)) is not None:
            parts.append(np.array([*place, -0.8]) + rng.normal(0, 0.4, (30, 3)))
    points = np.vstack(parts)
    return np.column_stack([points, rng.uniform(0, 1, len(points))])


def episodes() -> list[Episode]:
    """A discrepancy counts once it has lasted for a second; it is over with the first list that has the thing again."""
    latency = max(LATENCY_NS.values()) / SECOND
    return [
        Episode("shadow-mode", "ego", each.start_s + PERSIST_S, each.end_s, 0.5 + latency)
        for each in sorted(TRUTH, key=lambda each: each.start_s)
        if each.end_s - each.start_s > PERSIST_S
    ]


def check(played: Played, sent: list[Message]) -> Iterator[str]:
    """Each recording holds the inputs and outputs of both, from three seconds before until two seconds after."""
    ended = [event for event in played.events if not event.started]
    for event, folder in zip(ended, played.recordings("shadow-mode"), strict=False):  # their number is checked already
        first, last = seconds(event.episode.onset_time) - BEFORE_S, seconds(event.end_time or 0) + AFTER_S
        yield from missing_messages(
            within(sent, ["ego"], first, last), read_recording(folder), f"the recording {folder.name}"
        )


def picture(due: list[Episode]) -> str:
    """The objects ahead, the errors over time, and the recordings."""
    chart = Chart(DURATION_S)
    curves = []
    for thing in THINGS:
        places = [(t / 5, thing.seen_from(t / 5)) for t in range(DURATION_S * 5)]
        curves.append((thing.name, [(t, place[0]) for t, place in places if place is not None]))
    chart.curves("metres ahead of the vehicle", curves, -BEHIND, AHEAD)
    for only, title in ((SHADOW, "only in shadow mode"), (EXISTING, "only the existing one")):
        rows = [(each.thing, [(each.start_s, each.end_s, "")]) for each in TRUTH if each.only == only]
        chart.bars(title, rows, "#8e5ea2")
    spans = [(each.start_s - BEFORE_S, (each.end_s or DURATION_S) + AFTER_S, "") for each in due]
    chart.bars("recorded: inputs and outputs of both", [("ego", spans)], "#d1495b")
    return chart.svg()
