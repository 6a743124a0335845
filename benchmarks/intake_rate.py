"""How many samples a second `detector run` takes from Zenoh into its buffer, beside a callback that only counts.

Publishers send poses of fifteen vehicles as fast as they can with congestion control BLOCK: nothing is dropped on the
way, so what they manage to send is what the receiver takes. Receivers alternate: a bare zenoh-python subscriber whose
callback counts, and `detector run` with the rules of the cooperative-recording example active. All samples must have
arrived in the detector's buffer, or the run does not count.

    python benchmarks/intake_rate.py [--rounds 5] [--seconds 5] [--publishers 1 2]
"""

from __future__ import annotations

import argparse
import json
import re
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml
import zenoh
from rosbags.typesys import Stores, get_typestore

EXAMPLE = Path(__file__).parents[1] / "examples" / "cooperative-recording"
TARGET = 0.9
PATIENCE = 20.0  # s until a publisher gives up on its subscriber


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--publishers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--role", choices=["publisher", "bare"], help=argparse.SUPPRESS)
    parser.add_argument("--endpoint", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role == "publisher":
        publish(options.endpoint, options.seconds)
        return
    if options.role == "bare":
        count(options.endpoint)
        return
    for publishers in options.publishers:
        rates: dict[str, list[float]] = {"bare": [], "detector": []}
        for _ in range(options.rounds):
            for receiver, found in rates.items():
                found.append(measure(receiver, publishers, options.seconds))
        bare, detector = (statistics.median(rates[receiver]) for receiver in ("bare", "detector"))
        ratios = sorted(d / b for d, b in zip(rates["detector"], rates["bare"], strict=True))
        print(
            f"{publishers} publisher(s): bare callback {bare / 1e3:.0f} k/s, detector run {detector / 1e3:.0f} k/s, "
            f"ratio of medians {detector / bare:.2f} (pairs {ratios[0]:.2f} to {ratios[-1]:.2f}; target {TARGET})"
        )


def measure(receiver: str, publishers: int, seconds: float) -> float:
    """One run; samples a second."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{found.getsockname()[1]}"
    with tempfile.TemporaryDirectory() as folder:
        process = start_receiver(receiver, endpoint, Path(folder))
        senders = [
            subprocess.Popen(
                [sys.executable, __file__, "--role", "publisher", "--endpoint", endpoint, "--seconds", str(seconds)],
                stdout=subprocess.PIPE,
                text=True,
            )
            for _ in range(publishers)
        ]
        told = [sender.communicate()[0] for sender in senders]
        if any(sender.returncode for sender in senders):
            process.kill()
            raise SystemExit(f"{receiver}: the publishers found no subscriber\n{process.communicate()[1]}")
        sent = [json.loads(each) for each in told]
        time.sleep(1.0)  # what Zenoh has taken from the publishers must reach the callback
        process.send_signal(signal.SIGTERM)
        report = process.communicate(timeout=60)[1]
    total = sum(each["count"] for each in sent)
    arrived = int(re.search(r"(\d+) samples in", report)[1])  # type: ignore[index]
    if arrived != total:
        raise SystemExit(f"{receiver}: {total} samples were sent, {arrived} arrived: the run proves nothing\n{report}")
    return sum(each["count"] / each["seconds"] for each in sent)


def start_receiver(receiver: str, endpoint: str, folder: Path) -> subprocess.Popen[str]:
    if receiver == "bare":
        command = [sys.executable, __file__, "--role", "bare", "--endpoint", endpoint]
    else:
        document = yaml.safe_load((EXAMPLE / "detector.yaml").read_text())
        document["spec"]["zenoh"]["listen"] = [endpoint]
        (folder / "detector.yaml").write_text(yaml.safe_dump(document))
        command = [
            sys.executable, "-m", "detector.cli", "run", "--detector", str(folder / "detector.yaml"),
            "--rules", str(EXAMPLE / "rules.yaml"), "--output", str(folder / "out"),
        ]  # fmt: skip
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def settings(**values: object) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in values.items():
        config.insert_json5(key.replace("__", "/"), json.dumps(value))
    config.insert_json5("scouting/multicast/enabled", "false")
    return config


def count(endpoint: str) -> None:
    """The baseline: a callback that does nothing but count."""
    total = 0

    def receive(_: zenoh.Sample) -> None:
        nonlocal total
        total += 1

    with zenoh.open(settings(listen__endpoints=[endpoint])) as session:
        session.declare_subscriber("vehicles/*/pose", receive)
        session.declare_subscriber("vehicles/*/points", receive)
        signal.sigwait({signal.SIGTERM})
        time.sleep(0.2)
    print(f"{total} samples in", file=sys.stderr)


def publish(endpoint: str, seconds: float) -> None:
    """Send poses for so many seconds, as fast as they are taken."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    payload = pose()
    config = settings(connect__endpoints=[endpoint], connect__timeout_ms=20_000, listen__endpoints=[])
    with zenoh.open(config) as session:
        publishers = [
            session.declare_publisher(f"vehicles/car{i}/pose", congestion_control=zenoh.CongestionControl.BLOCK)
            for i in range(15)
        ]
        patience = time.monotonic() + PATIENCE
        while not all(publisher.matching_status.matching for publisher in publishers):
            if time.monotonic() > patience:
                raise SystemExit(f"nobody subscribed within {PATIENCE:g} s")
            time.sleep(0.01)
        begin = time.monotonic()
        sent = 0
        while time.monotonic() - begin < seconds:
            for _ in range(100):
                for publisher in publishers:
                    publisher.put(payload)
            sent += 1500
        taken = time.monotonic() - begin
        time.sleep(0.5)  # closing the session would drop what it still holds
    print(json.dumps({"count": sent, "seconds": taken}))


def pose() -> bytes:
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](1_767_225_600, 0), "map")
    point = types["geometry_msgs/msg/Point"](1.0, 2.0, 0.0)
    turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    message = types["geometry_msgs/msg/PoseStamped"](header, types["geometry_msgs/msg/Pose"](point, turn))
    return bytes(store.serialize_cdr(message, "geometry_msgs/msg/PoseStamped"))


if __name__ == "__main__":
    if "--role" in sys.argv and "bare" in sys.argv:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})  # before Zenoh's threads, so that sigwait gets it
    main()
