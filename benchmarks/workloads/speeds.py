"""Workload W1: the speeds of clients at a fixed rate, and rules over the maximum of the last seconds."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from mcap.writer import Writer

from detector.engine.samples.sample import Arrival
from tests.ros_messages import cdr, pose_stamped
from wayside.api import Detector, EventRule

START = 1_700_000_000_000_000_000
"""Nanoseconds since the epoch; a whole multiple of every rule's period."""

TICK = 100_000_000
"""Every rule's period in nanoseconds."""

LONGEST = 5
"""Windows are of 1, 2, … seconds up to this."""

POSE = "geometry_msgs/msg/PoseStamped"

X = 1234.5
"""A number that occurs once in a message."""

MEAN, SWING, PACE = 27.0, 8.0, 0.7  # m/s, m/s, rad/s


class Limits(NamedTuple):
    """The condition of a rule: an episode starts above one speed and ends below another. Seconds; m/s."""

    name: str
    window: int
    above: float
    below: float


def limits(count: int) -> list[Limits]:
    """The limits of `count` rules. All differ, and every client crosses each about every 9 s."""
    found = []
    for number in range(count):
        window, step = number % LONGEST + 1, number // LONGEST % 10
        lowest = MEAN - SWING * math.cos(PACE * window / 2)  # what the maximum over the window falls to
        room = MEAN + SWING - lowest
        above, below = lowest + room * (0.55 + 0.04 * step), lowest + room * (0.05 + 0.04 * step)
        found.append(Limits(f"fast-{number}", window, round(above, 2), round(below, 2)))
    return found


def detector_document(keep: str = "10s") -> dict[str, Any]:
    """A Detector with one stream of JSON that keeps this much of it."""
    stream = {"name": "speed", "key": "vehicles/${client:*}/speed", "encoding": "json", "buffer": {"duration": keep}}
    return {
        "apiVersion": "wayside.dev/v1alpha1",
        "kind": "Detector",
        "metadata": {"name": "speeds"},
        "spec": {"mode": "Standalone", "streams": [stream], "buffer": {"bytes": "10Gi"}},
    }


def rule_document(rule: Limits, evaluation: dict[str, str]) -> dict[str, Any]:
    """The EventRule as a user writes it."""
    over = {"over": f"{rule.window}s", "aggregate": "Max"}
    return {
        "apiVersion": "wayside.dev/v1alpha1",
        "kind": "EventRule",
        "metadata": {"name": rule.name},
        "spec": {
            "evaluation": evaluation,
            "signals": [{"name": "top", "stream": "speed", "value": "msg.speed", **over}],
            "when": f"top > {rule.above}",
            "until": f"top < {rule.below}",
        },
    }


def detector(keep: str = "10s") -> Detector:
    """The Detector, which keeps this much of the stream."""
    return Detector.model_validate(detector_document(keep))


def rules(count: int) -> list[EventRule]:
    """Rules that are evaluated every 100 ms."""
    return [EventRule.model_validate(rule_document(each, {"every": "100ms"})) for each in limits(count)]


def rules_on_sample(count: int) -> list[EventRule]:
    """The same rules, evaluated with each sample."""
    return [EventRule.model_validate(rule_document(each, {"onSample": "speed"})) for each in limits(count)]


def write_documents(folder: Path, count: int, *, poses: bool = False) -> tuple[Path, Path]:
    """The Detector and the rules as YAML files; `poses`: for the recording of `write_mcap`."""
    files = folder / "detector.yaml", folder / "rules.yaml"
    detector, rules = detector_document(), [rule_document(each, {"every": "100ms"}) for each in limits(count)]
    if poses:
        detector["spec"]["streams"][0] |= {"encoding": "cdr", "type": POSE}
        for rule in rules:
            rule["spec"]["signals"][0]["value"] = "msg.pose.position.x"
    files[0].write_text(yaml.safe_dump(detector))
    files[1].write_text(yaml.safe_dump_all(rules))
    return files


def arrivals(clients: int, hz: int, seconds: float) -> Iterator[Arrival]:
    """The samples in order of time, the clients' spread evenly over each period; the first is exactly at a tick."""
    keys = [f"vehicles/c{client}/speed" for client in range(clients)]
    shift = 1_000_000_000 // hz // clients
    for number in range(round(hz * seconds)):
        time = START + number * 1_000_000_000 // hz
        for client, key in enumerate(keys):
            speed = MEAN + SWING * math.sin(PACE * number / hz + client)
            yield Arrival(time + client * shift, "speed", key, b'{"speed": %.3f}' % speed)


def write_json_lines(path: Path, of: Sequence[Arrival]) -> None:
    """A recording of these arrivals, as `detector replay` reads it."""
    with path.open("w", encoding="utf-8") as file:
        for each in of:
            file.write(f'{{"t": {each.received}, "key": {json.dumps(each.key)}, "value": {each.payload.decode()}}}\n')


def write_mcap(path: Path, of: Sequence[Arrival]) -> None:
    """A recording of poses, compressed with zstd, of which x is the speed of these arrivals."""
    pose = cdr(pose_stamped(x=X))
    before, after = pose.split(struct.pack("<d", X))
    channels: dict[str, int] = {}
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(POSE, "ros2msg", b"")
        for each in of:
            if each.key not in channels:
                channels[each.key] = writer.register_channel(f"/{each.key}", "cdr", schema)
            payload = before + struct.pack("<d", json.loads(each.payload)["speed"]) + after
            writer.add_message(channels[each.key], each.received, payload, each.received)
        writer.finish()


def write_limits(path: Path, count: int) -> None:
    """The rules as the peer reads them, `name,window,above,below` a line."""
    path.write_text("".join(f"{each.name},{each.window},{each.above!r},{each.below!r}\n" for each in limits(count)))
