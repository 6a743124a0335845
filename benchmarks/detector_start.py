"""Start of a detector → its first subscription, compared with a minimal Zenoh program; the image's size.

Measured: `detector run` with the cooperative-recording example, from its start until a publisher in this process sees
a subscription to its key. The baseline: a Python program that opens a session and subscribes, seen the same way.
The two in turn. Exits with 1 where the median start misses its target.

    python -m benchmarks.detector_start [--rounds 5]
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml
import zenoh

from tests.gobuild import cache
from tests.ports import free_endpoint

EXAMPLE = Path(__file__).parents[1] / "examples" / "cooperative-recording"
TARGET_S = 2.0
PATIENCE = 120.0  # s
KEY = "vehicles/car1/pose"
LEAST = """
import sys, time, zenoh
config = zenoh.Config()
config.insert_json5("connect/endpoints", f'["{sys.argv[1]}"]')
config.insert_json5("scouting/multicast/enabled", "false")
session = zenoh.open(config)
subscriber = session.declare_subscriber("vehicles/*/pose", lambda sample: None)
time.sleep(1000)
"""


def main() -> int:
    """Measure and print; 1 means that the target was missed."""
    parser = argparse.ArgumentParser(prog="detector_start", description=__doc__)
    parser.add_argument("--rounds", type=int, default=5, help="of each kind (%(default)s)")
    options = parser.parse_args()
    endpoint = free_endpoint()
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["{endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    ours, least = [], []
    with tempfile.TemporaryDirectory() as folder, zenoh.open(config) as session:
        publisher = session.declare_publisher(KEY)
        detector = Path(folder) / "detector.yaml"
        manifest = yaml.safe_load((EXAMPLE / "detector.yaml").read_text())
        manifest["spec"]["zenoh"] = {"mode": "client", "connect": [endpoint]}
        detector.write_text(yaml.safe_dump(manifest))
        run = [
            sys.executable,
            "-m",
            "detector.commands.cli",
            "run",
            f"--detector={detector}",
            f"--rules={EXAMPLE}/rules.yaml",
        ]
        run += [f"--output={folder}/output"]
        for _ in range(options.rounds):
            ours.append(_until_subscribed(run, publisher))
            least.append(_until_subscribed([sys.executable, "-c", LEAST, endpoint], publisher))
    for name, seconds in (("detector", ours), ("zenoh alone", least)):
        print(f"{name:12} median {statistics.median(seconds):.2f} s, from {min(seconds):.2f} to {max(seconds):.2f} s")
    start = statistics.median(ours)
    print(f"ratio of the medians: {start / statistics.median(least):.1f}; target of the start: {TARGET_S:g} s")
    for layer in sorted((cache() / "images").glob("*.tar")):
        print(f"layer of the image: {layer.name.split('-')[0]:10} {layer.stat().st_size / 1e6:.0f} MB, uncompressed")
    return 0 if start <= TARGET_S else 1


def _until_subscribed(command: list[str], publisher: zenoh.Publisher) -> float:
    """Seconds from the start of the program until the publisher has a subscriber; ends the program afterwards."""
    with tempfile.TemporaryFile("w+") as log:
        began = time.monotonic()
        process = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            _wait(lambda: publisher.matching_status.matching, process, log)
            return time.monotonic() - began
        finally:
            process.kill()
            process.wait()
            _wait(lambda: not publisher.matching_status.matching, None, log)


def _wait(holds, process, log) -> None:  # type: ignore[no-untyped-def]
    deadline = time.monotonic() + PATIENCE
    while not holds():
        if time.monotonic() > deadline or (process is not None and process.poll() is not None):
            log.seek(0)
            raise TimeoutError(f"no subscription comes or goes:\n{log.read()[-2000:]}")
        time.sleep(0.005)


if __name__ == "__main__":
    sys.exit(main())
