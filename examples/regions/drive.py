"""Vehicles that cross the borders of three regions, over Zenoh.

    python examples/regions/drive.py --connect tcp/127.0.0.1:7447

car-1 drives from the north to the south and requests a remote operator on the way. car-2 does the same in the opposite
direction. car-3 stays in the center and requests nobody.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import zenoh

BORDERS = (("north", "center", 1000.0), ("center", "south", 2000.0))
"""The two regions on both sides of each border, and where it is, in metres along the road."""

STRIP = 100.0
"""Metres on each side of a border, within which a vehicle publishes for both regions."""

SPEED = 20.0  # m/s
PERIOD = 0.2  # s between two messages of a vehicle
LENGTH = 3000.0  # m


def area(x: float) -> str:
    """The chunk of the key that names the regions of a position: `north`, `north+center`, `center` and on.

    `x` is in metres. No name of a region is part of another one, since a stream's key matches by `$*north$*`.
    """
    for before, after, border in BORDERS:
        if x < border - STRIP:
            return before
        if x <= border + STRIP:
            return f"{before}+{after}"
    return BORDERS[-1][1]


def message(vehicle: str, x: float, assistance: bool) -> tuple[str, dict[str, Any]]:
    """The key and the content of what a vehicle at this position publishes."""
    return f"town/{area(x)}/{vehicle}/state", {"x": round(x, 1), "assistance": assistance}


def main() -> None:
    """Drive once along the road."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", metavar="ENDPOINT", help="a router (%(default)s)")
    parser.add_argument("--speed", type=float, default=1.0, help="times as fast as it happens (%(default)g)")
    options = parser.parse_args()
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([options.connect]))
    with zenoh.open(config) as session:
        steps = round(LENGTH / (SPEED * PERIOD))
        for step in range(steps + 1):
            x = LENGTH * step / steps
            wanted = 300 < x < LENGTH - 300
            for vehicle, at, assistance in (
                ("car-1", x, wanted),
                ("car-2", LENGTH - x, wanted),
                ("car-3", 1500.0, False),
            ):
                key, content = message(vehicle, at, assistance)
                session.put(key, json.dumps(content))
            if step % 25 == 0:
                print(f"car-1 in {area(x)}, car-2 in {area(LENGTH - x)}")
            time.sleep(PERIOD / options.speed)


if __name__ == "__main__":
    main()
