"""How fast single fields are read from payloads, beside decoding the whole messages and looking the fields up.

Both give columns: a value for each payload and path. Rounds alternate; a rate is the median over the rounds, in CPU
time of this process.

    python -m benchmarks.field_reading [--rounds 7]
"""

from __future__ import annotations

import argparse
import gc
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from detector.engine.samples.sample import FieldDecoder
from detector.streams.codecs import CdrDecoder, JsonDecoder
from tests.ros_messages import cdr, header, make, odometry, pose_stamped

Path = tuple[str | int, ...]


class Case(NamedTuple):
    """Payloads, and the paths that are read."""

    name: str
    decoder: FieldDecoder
    paths: Sequence[Path]
    payloads: Sequence[bytes]
    target: float | None = None
    """Messages a second, on a machine with nothing else to do."""


def cases() -> list[Case]:
    image = make(
        "sensor_msgs/Image",
        header=header(),
        height=1000,
        width=1000,
        encoding="mono8",
        is_bigendian=0,
        step=1000,
        data=np.zeros(1_000_000, np.uint8),
    )
    position: list[Path] = [("pose", "position", "x"), ("pose", "position", "y")]
    moving: list[Path] = [*(("pose", *path) for path in position), ("twist", "twist", "linear", "x")]
    road_user = b'{"x": 1.5, "y": 2.5, "size": {"w": 2, "l": 4.5}, "class": "car"}'
    return [
        Case(
            "JSON, one field of three",
            JsonDecoder(),
            [("speed",)],
            [b'{"speed": %d.5, "heading": 1.25, "gear": 3}' % n for n in range(20_000)],
            2.5e6,
        ),
        Case(
            "JSON, one field beside 30 maps",
            JsonDecoder(),
            [("speed",)],
            [b'{"speed": %d.5, "users": [%s]}' % (n, b", ".join([road_user] * 30)) for n in range(400)],
        ),
        Case(
            "PoseStamped, two fields",
            CdrDecoder("geometry_msgs/msg/PoseStamped"),
            position,
            [cdr(pose_stamped(n, -n, seconds=n)) for n in range(10_000)],
            1.5e6,
        ),
        Case("Odometry, three fields", CdrDecoder("nav_msgs/msg/Odometry"), moving, copies(cdr(odometry()), 10_000)),
        Case(
            "Image of 1 MB, its stamp and frame",
            CdrDecoder("sensor_msgs/msg/Image"),
            [("header", "stamp", "sec"), ("header", "frame_id")],
            copies(cdr(image), 100),
        ),
    ]


def copies(payload: bytes, count: int) -> list[bytes]:
    """Copies in separate memory, as received from the network."""
    return [bytes(bytearray(payload)) for _ in range(count)]


def by_decoding(case: Case) -> list[list[Any]]:
    columns: list[list[Any]] = [[] for _ in case.paths]
    for payload in case.payloads:
        message = case.decoder.decode(payload)
        for path, column in zip(case.paths, columns, strict=True):
            value = message
            for step in path:
                value = value[step]
            column.append(value)
    return columns


def seconds(work: Callable[[], object]) -> float:
    gc.collect()
    begin = time.process_time()
    work()
    return time.process_time() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    rounds = parser.parse_args().rounds
    for case in cases():
        read = case.decoder.field_reader(case.paths)
        assert read is not None
        found = read(case.payloads)
        assert not found.errors
        assert [list(column) for column in found.columns] == by_decoding(case)
        pairs = [(seconds(lambda: by_decoding(case)), seconds(lambda: read(case.payloads))) for _ in range(rounds)]  # noqa: B023
        whole, fields = (len(case.payloads) / statistics.median(times) for times in zip(*pairs, strict=True))
        rates = f"whole {whole / 1e3:7,.0f} k/s, fields {fields / 1e3:7,.0f} k/s: {fields / whole:.1f} times"
        print(f"{case.name:36} {rates}" + (f" (target {case.target / 1e6:.1f} M/s)" if case.target else ""))


if __name__ == "__main__":
    main()
