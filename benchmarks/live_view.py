"""The cost of a live view: `detector run --foxglove` with a client of 20 channels, compared with none.

A hundred vehicles send at 10 Hz; eight rules are about each of them, two about pairs. One detector runs throughout, and
a client that is not the SDK's own connects and leaves in turn; measured is the detector's CPU time. The aim: at most 10
% more. On a machine that is too busy the detector leaves out evaluations, and the ratio means little: their number is
printed.

    python -m benchmarks.live_view [--vehicles 100] [--seconds 20] [--rounds 3]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
import zenoh
from websockets.sync.client import ClientConnection, connect

from benchmarks.intake_rate import settings
from benchmarks.replay_results import HZ, write
from benchmarks.sidecar_cost import cost
from tests.ports import free_endpoint, free_port

TARGET = 1.10
CHANNELS = 20
PROTOCOL: Any = "foxglove.sdk.v1"


def main() -> int:
    """Measure and print; 1 means that the target was missed."""
    parser = argparse.ArgumentParser(prog="live_view", description=__doc__)
    parser.add_argument("--vehicles", type=int, default=100, help="(%(default)s)")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each measurement (%(default)g)")
    parser.add_argument("--rounds", type=int, default=3, help="with and without in turn (%(default)s)")
    options = parser.parse_args()
    without, attached, messages = [], [], 0
    with running(options.vehicles) as (pid, port, log):
        time.sleep(35)  # windows are full, and all channels are open
        for _ in range(options.rounds):
            without.append(cost(pid, options.seconds).cpu)
            with viewer(port) as came:
                time.sleep(2)
                before = came[0]
                attached.append(cost(pid, options.seconds).cpu)
                messages += came[0] - before
            time.sleep(2)
        left_out = log.read_text().count("low-priority rules are now thinned at level")
    ratio = statistics.median(attached) / statistics.median(without)
    shown = messages / (options.rounds * options.seconds)
    print(f"{options.vehicles} vehicles at {HZ} Hz, 10 rules; medians of {options.rounds}, CPU as a part of one core")
    print(f"without a client    {statistics.median(without):6.1%}")
    print(f"{CHANNELS} channels attached {statistics.median(attached):6.1%}   {ratio:.2f} times (target {TARGET:.2f})")
    print(f"{shown:.0f} messages a second; evaluations were left out {left_out} times")
    return 0 if ratio <= TARGET else 1


@contextlib.contextmanager
def running(vehicles: int) -> Iterator[tuple[int, int, Path]]:
    """The detector's pid, the view's port and the log, while the vehicles drive."""
    endpoint, port, over = free_endpoint(), free_port(), threading.Event()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder, 1, 1)
        document = yaml.safe_load((folder / "detector.yaml").read_text())
        document["spec"]["zenoh"] = {"mode": "peer", "listen": [endpoint], "scouting": False}
        (folder / "detector.yaml").write_text(yaml.safe_dump(document))
        command = [
            sys.executable,
            "-m",
            "detector.commands.cli",
            "run",
            "--detector",
            "detector.yaml",
            "--rules",
            "rules.yaml",
        ]
        with (folder / "log").open("wb") as log:
            process = subprocess.Popen([*command, "--foxglove", str(port)], cwd=folder, stdout=log, stderr=log)
        driving = threading.Thread(target=drive, args=(endpoint, vehicles, over))
        driving.start()
        try:
            yield process.pid, port, folder / "log"
        finally:
            over.set()
            driving.join()
            process.terminate()
            process.wait()


def drive(endpoint: str, vehicles: int, over: threading.Event) -> None:
    """Send until it is over."""
    config = settings(connect__endpoints=[endpoint], connect__timeout_ms=20_000, listen__endpoints=[])
    with zenoh.open(config) as session:
        begin, step = time.monotonic(), 0
        while not over.wait(max(0.0, begin + step / HZ - time.monotonic())):
            at = step / HZ
            for car in range(vehicles):
                phase = car * 0.7
                value = {
                    "x": 300 * math.cos(at * 0.05 + phase) + 20 * car,
                    "y": 200 * math.sin(at * 0.04 + phase * 1.3),
                    "speed": 15 + 8 * math.sin(at * 0.11 + phase) + 0.3 * math.sin(at * 1.7),
                    "brake": math.sin(at * 0.3 + phase) > 0.9,
                }
                session.put(f"vehicles/car{car}/odom", json.dumps(value))
            step += 1


@contextlib.contextmanager
def viewer(port: int) -> Iterator[list[int]]:
    """A client of the first channels of rules about vehicles; counts the messages that come."""
    came, over = [0], threading.Event()
    with connect(f"ws://127.0.0.1:{port}", subprotocols=[PROTOCOL], max_size=None) as socket:
        chosen: dict[str, int] = {}
        while len(chosen) < CHANNELS:
            message = socket.recv(30)
            for channel in json.loads(message).get("channels", ()) if isinstance(message, str) else ():
                if channel["topic"].startswith("/wayside/rule-") and len(chosen) < CHANNELS:
                    chosen[channel["topic"]] = channel["id"]
        subscriptions = [{"id": number, "channelId": channel} for number, channel in enumerate(chosen.values())]
        socket.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
        receiving = threading.Thread(target=receive, args=(socket, came, over))
        receiving.start()
        try:
            yield came
        finally:
            over.set()
            receiving.join()


def receive(socket: ClientConnection, came: list[int], over: threading.Event) -> None:
    """Count messages until it is over."""
    while not over.is_set():
        with contextlib.suppress(TimeoutError):
            message = socket.recv(0.5)
            came[0] += isinstance(message, bytes) and struct.unpack_from("<B", message)[0] == 1


if __name__ == "__main__":
    sys.exit(main())
