"""Three cars on roads with potholes, speed bumps and cobblestones. The truth is where these are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from shaking import RATE_HZ, Samples, add, asphalt, cobbles, pothole, speed_bump

from examples.running.drawing import Chart
from examples.running.playing import Played, seconds
from examples.running.recording import missing_messages, read_recording
from examples.running.ros import header, make, ros_message
from examples.running.scenario import SECOND, START_NS, Episode, Message, Scenario, as_json

SEED = 11
DURATION_S = 50
SPEED = 1e-4
"""Degrees north a second, 11 m/s."""
IMU = "sensor_msgs/msg/Imu"


@dataclass(frozen=True, slots=True)
class Obstacle:
    """An obstacle that a car drives over, from one second to another."""

    car: str
    kind: str
    start_s: float
    end_s: float


TRUTH = (
    Obstacle("car-1", "pothole", 8.0, 8.14),
    Obstacle("car-1", "bump", 16.0, 16.6),
    Obstacle("car-1", "pothole", 23.3, 23.44),
    Obstacle("car-1", "cobbles", 30.0, 42.0),
    Obstacle("car-1", "pothole", 36.5, 36.64),  # among cobblestones
    Obstacle("car-2", "bump", 10.0, 10.6),
    Obstacle("car-2", "cobbles", 15.0, 25.0),
    Obstacle("car-2", "bump", 19.0, 19.6),
    Obstacle("car-2", "bump", 33.0, 33.6),
    Obstacle("car-2", "bump", 34.0, 34.6),
    Obstacle("car-3", "bump", 20.0, 20.6),
    Obstacle("car-3", "pothole", 21.5, 21.64),  # right behind a bump
)
CARS = ("car-1", "car-2", "car-3")


def scenario(seed: int = SEED) -> Scenario:
    """Not quite a minute."""
    due = episodes()
    return Scenario(
        title="Potholes, found by a model",
        seed=seed,
        messages=lambda: messages(seed),
        episodes=due,
        actions={"pothole-detection/road-operator": len(due), "pothole-detection/training-data": len(due)},
        picture=lambda: picture(seed, due),
        check=lambda played: check(played, list(messages(seed))),
    )


def messages(seed: int) -> Iterator[Message]:
    """Fifty messages of the inertial sensor a second, and one with the car's position."""
    rest = np.zeros(9)
    for number, car in enumerate(CARS):
        for index, value in enumerate(shaking(car, seed)):
            after = index * SECOND // RATE_HZ + number * SECOND // 1000
            message = make(
                IMU, header=header(after, f"{car}/imu"),
                orientation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
                orientation_covariance=rest, angular_velocity=make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0),
                angular_velocity_covariance=rest,
                linear_acceleration=make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=9.81 + float(value)),
                linear_acceleration_covariance=rest,
            )  # fmt: skip
            yield ros_message(after, f"vehicles/{car}/imu", IMU, message)
        for second in range(DURATION_S):
            content = {"latitude": latitude(second), "longitude": 6.08 + 0.01 * number}
            yield Message(
                second * SECOND + SECOND // 2 + (5 + number) * SECOND // 1000, f"vehicles/{car}/place", as_json(content)
            )


def shaking(car: str, seed: int) -> Samples:
    """The car's vertical acceleration, without gravity."""
    rng = np.random.default_rng([seed, CARS.index(car)])
    road = asphalt(DURATION_S * RATE_HZ, rng)
    for thing in (each for each in TRUTH if each.car == car):
        start, count = round(thing.start_s * RATE_HZ), round((thing.end_s - thing.start_s) * RATE_HZ)
        shapes = {"pothole": pothole, "bump": speed_bump}
        add(road, cobbles(count, rng) if thing.kind == "cobbles" else shapes[thing.kind](rng), start)
    return road


def latitude(t: float) -> float:
    """Where a car is that second, degrees north."""
    return 50.77 + SPEED * t


def episodes() -> list[Episode]:
    """Each pothole, as soon as it has been in the window for a little, and until it has left it again."""
    return [
        Episode("pothole-detection", each.car, each.start_s + 0.2, each.start_s + 0.8, 0.7)
        for each in TRUTH
        if each.kind == "pothole"
    ]


def check(played: Played, sent: list[Message]) -> Iterator[str]:
    """The road operator received the right places, and the recordings contain all data around them."""
    reported = sorted((each.content["subject"], float(_labels(each.content)["latitude"])) for each in played.notices)
    must = sorted((each.car, latitude(each.start_s)) for each in TRUTH if each.kind == "pothole")
    for (car, logged), (_, truth) in zip(reported, must, strict=False):  # their number is checked already
        if not abs(logged - truth) < 2 * SPEED:
            yield f"the road operator received a pothole of {car} at {logged}; it is at {truth:.5f}"
    ends = [each for each in played.events if not each.started]
    spans = sorted((each.episode.onset_time, each.time, each.episode.subject) for each in ends)
    for folder, (onset, end, car) in zip(played.recordings("pothole-detection"), spans, strict=False):
        around = [
            each for each in sent
            if each.key.split("/")[1] == car and onset - 2 * SECOND < START_NS + each.after_ns <= end + SECOND
        ]  # fmt: skip
        yield from missing_messages(around, read_recording(folder), f"the recording of {car} at {seconds(onset):g} s")


def _labels(content: dict[str, dict[str, dict[str, dict[str, str]]]]) -> dict[str, str]:
    return content["data"]["notification"]["labels"]


def picture(seed: int, due: list[Episode]) -> str:
    """The accelerations of the cars, the obstacles, and the detections."""
    chart = Chart(DURATION_S)
    for car in CARS[:2]:
        values = [(index / RATE_HZ, float(value)) for index, value in enumerate(shaking(car, seed))]
        chart.curves(f"vertical acceleration of {car}, m/s²", [(car, values)], -12, 12)
    for kind in ("pothole", "bump", "cobbles"):
        rows = [(car, [(e.start_s, e.end_s, "") for e in TRUTH if (e.car, e.kind) == (car, kind)]) for car in CARS]
        chart.bars(kind, rows)
    found = [(car, [(e.start_s, e.end_s or DURATION_S, "") for e in due if e.subject == car]) for car in CARS]
    chart.bars("found", found, "#d1495b")
    return chart.svg()
