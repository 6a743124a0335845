"""Two shuttles with three cameras each. The one's cameras fail and come back; the other stands in the dark.

The truth is which camera is broken when, and how. From it follow the pictures, and what must become of perception and
speed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from examples.running.drawing import Chart
from examples.running.ros import header, make, ros_message
from examples.running.scenario import SECOND, Episode, Message, Moment, Scenario

SEED = 3
DURATION_S = 40
RATE_HZ = 10
WIDTH, HEIGHT = 96, 64
CAMERAS = ("front", "left", "right")
SHUTTLES = ("shuttle-1", "shuttle-2")
IMAGE = "sensor_msgs/msg/Image"
FULL_SPEED, WITHOUT_FRONT, WITHOUT_SIDE = 13.9, 4.0, 8.0
"""m/s that a shuttle may drive with all cameras, without the front one, without one at the side."""


@dataclass(frozen=True, slots=True)
class Fault:
    """A camera is broken in some way from one second to another."""

    shuttle: str
    camera: str
    kind: str
    start_s: float
    end_s: float

    def at(self, t: float) -> bool:
        """Whether it is broken at that second."""
        return self.start_s <= t < self.end_s


TRUTH = (
    Fault("shuttle-1", "right", "black", 3.0, 3.2),  # two pictures: too short to matter
    Fault("shuttle-1", "front", "black", 8.0, 16.0),
    Fault("shuttle-1", "left", "frozen", 20.0, 32.0),
    Fault("shuttle-1", "front", "black", 24.0, 28.0),  # both at once
)
_MATTERS_S = 1.0
"""A fault that lasts less is none."""


def scenario(seed: int = SEED) -> Scenario:
    """Forty seconds."""
    due = episodes()
    return Scenario(
        title="Camera fault",
        seed=seed,
        messages=lambda: messages(seed),
        episodes=due,
        actions={
            "camera-fault/perception": 3, "camera-fault/speed": 3,
            "shuttle-present/perception": 2, "shuttle-present/driving": 2,
        },
        moments=[moment(at) for at in (2.0, 5.0, 12.0, 18.5, 22.5, 26.5, 30.5, 36.0)],
        picture=lambda: picture(due),
    )  # fmt: skip


def messages(seed: int) -> Iterator[Message]:
    """The pictures of all cameras, ten a second each."""
    for shuttle in SHUTTLES:
        for number, camera in enumerate(CAMERAS):
            rng = np.random.default_rng([seed, SHUTTLES.index(shuttle), number])
            last: NDArray[np.uint8] = np.zeros((HEIGHT, WIDTH), np.uint8)
            for index in range(DURATION_S * RATE_HZ):
                after = index * SECOND // RATE_HZ + (number + 1) * SECOND // 100
                broken = next((each for each in TRUTH if (each.shuttle, each.camera) == (shuttle, camera)
                               and each.at(after / SECOND)), None)  # fmt: skip
                pixels = last
                if broken is None:
                    pixels = last = _picture(rng, after / SECOND, dark=shuttle == "shuttle-2")
                elif broken.kind == "black":
                    pixels = np.zeros((HEIGHT, WIDTH), np.uint8)
                image = make(
                    IMAGE, header=header(after, f"{shuttle}/{camera}"), height=HEIGHT, width=WIDTH, encoding="mono8",
                    is_bigendian=0, step=WIDTH, data=pixels.reshape(-1),
                )  # fmt: skip
                yield ros_message(after, f"vehicles/{shuttle}/camera/{camera}/image", IMAGE, image)


def _picture(rng: np.random.Generator, t: float, *, dark: bool) -> NDArray[np.uint8]:
    """A road below a sky, and a car on it; in the dark all but black, and nothing moves."""
    rows = np.linspace(200, 60, HEIGHT)[:, None]
    scene = np.repeat(rows, WIDTH, axis=1)
    left = 40 if dark else round(WIDTH / 2 + 30 * math.sin(t / 3))
    scene[HEIGHT // 2 : HEIGHT // 2 + 12, left : left + 16] = 25
    scene = scene * (0.015 if dark else 1.0) + rng.normal(0, 0.8 if dark else 3.0, scene.shape)
    return np.clip(scene, 0, 255).astype(np.uint8)


def episodes() -> list[Episode]:
    """A fault is found when all pictures of a second are bad, and is over when all of a second are good."""
    faults = [
        Episode("camera-fault", f"{each.shuttle}~{each.camera}", each.start_s + 0.8, each.end_s + 0.8, 0.6)
        for each in TRUTH
        if each.end_s - each.start_s > _MATTERS_S
    ]
    return faults + [Episode("shuttle-present", shuttle, 0.0, None) for shuttle in SHUTTLES]


def moment(at_s: float) -> Moment:
    """The expected applications at a time that is more than two seconds from any change."""
    runs: dict[str, dict[str, object]] = {}
    for shuttle in SHUTTLES:
        broken = [each.camera for each in TRUTH if each.shuttle == shuttle and each.at(at_s)]
        speed = WITHOUT_FRONT if "front" in broken else WITHOUT_SIDE if broken else FULL_SPEED
        cameras = [camera for camera in CAMERAS if camera not in broken]
        runs[f"perception/{shuttle}"] = {"vehicle": shuttle, "cameras": cameras}
        runs[f"driving/{shuttle}"] = {"vehicle": shuttle, "maxSpeed": speed}
    return Moment(at_s, runs)


def picture(due: list[Episode]) -> str:
    """Which camera is broken when, what is found, and the speed that follows."""
    chart = Chart(DURATION_S)
    rows = [
        (f"shuttle-1 {camera}", [(each.start_s, each.end_s, each.kind if each.end_s - each.start_s > 1 else "")
                                 for each in TRUTH if each.camera == camera])
        for camera in CAMERAS
    ]  # fmt: skip
    chart.bars("the pictures are", rows)
    found = [each for each in due if each.rule == "camera-fault"]
    chart.bars(
        "perception does without",
        [
            (subject.replace("~", " "), [(each.start_s, each.end_s or DURATION_S, "") for each in found
                                         if each.subject == subject])
            for subject in dict.fromkeys(each.subject for each in found)
        ],
        "#d1495b",
    )  # fmt: skip
    speed = []
    for t in np.arange(0, DURATION_S, 0.1):
        without = [each.subject for each in found if each.start_s <= t < (each.end_s or DURATION_S)]
        limit = WITHOUT_FRONT if "shuttle-1~front" in without else WITHOUT_SIDE if without else FULL_SPEED
        speed.append((float(t), limit))
    chart.curves("maximum speed of shuttle-1, m/s", [("shuttle-1", speed)], 0, 15)
    return chart.svg()
