"""The cost of results: `detector replay` with all results, compared with the same replay without them.

Twenty vehicles drive for an hour at 10 Hz; eight rules are about each of them, two about pairs. Both replays are
processes, from a file of JSON lines; measured is their CPU time. The aim: at most 1.5 times that without, and 5 s.

    python -m benchmarks.replay_results [--vehicles 20] [--seconds 3600] [--repeat 1]
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import yaml

from tests.recorded import write_json_lines

HZ = 10
START = 1_700_000_000_000_000_000
RATIO, ALLOWANCE_S = 1.5, 5.0


def main() -> int:
    """Measure and print; 1 means that results cost more than they may."""
    parser = argparse.ArgumentParser(prog="replay_results", description=__doc__)
    parser.add_argument("--vehicles", type=int, default=20, help="(%(default)s)")
    parser.add_argument("--seconds", type=int, default=3600, help="of data (%(default)s)")
    parser.add_argument("--repeat", type=int, default=1, help="rounds (%(default)s)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder, options.vehicles, options.seconds)
        times: dict[str, list[float]] = {"without": [], "with": []}
        for _ in range(options.repeat):
            times["without"].append(replayed(folder, "plain", []))
            times["with"].append(replayed(folder, "results", ["--results", "all"]))
        sizes = {path.name: path.stat().st_size / 1e6 for path in sorted((folder / "results").iterdir())}
        same = (folder / "plain/events.jsonl").read_bytes() == (folder / "results/events.jsonl").read_bytes()
    without, with_them = (statistics.median(times[each]) for each in ("without", "with"))
    print(
        f"{options.vehicles} vehicles, {options.seconds} s at {HZ} Hz, 10 rules; medians of {options.repeat}, CPU time"
    )
    print(f"without results {without:6.1f} s")
    print(f"with all        {with_them:6.1f} s   {with_them / without:.2f} times; {with_them - without:+.1f} s")
    print("MB: " + ", ".join(f"{each} {size:.1f}" for each, size in sizes.items()))
    if not same:
        print("the events differ")
    return 0 if same and with_them <= RATIO * without + ALLOWANCE_S else 1


def replayed(folder: Path, output: str, more: list[str]) -> float:
    """The CPU time of one replay, seconds."""
    command = [sys.executable, "-m", "detector.commands.cli", "replay", "drive.jsonl", "--detector", "detector.yaml"]
    command += ["--rules", "rules.yaml", "--output", output, *more]
    before = os.times()
    subprocess.run(command, cwd=folder, check=True, stderr=subprocess.DEVNULL)
    after = os.times()
    return (after.children_user + after.children_system) - (before.children_user + before.children_system)


def write(folder: Path, vehicles: int, seconds: int) -> None:
    """The recording, the Detector and the rules."""
    write_json_lines(folder / "drive.jsonl", messages(vehicles, seconds))
    stream = {"name": "odom", "key": "vehicles/${client:*}/odom", "encoding": "json", "staleAfter": "1s"}
    head = {"apiVersion": "wayside.dev/v1alpha1"}
    detector = {**head, "kind": "Detector", "metadata": {"name": "cars"}, "spec": {"mode": "Standalone"}}
    detector["spec"] = {"mode": "Standalone", "streams": [stream]}
    (folder / "detector.yaml").write_text(yaml.safe_dump(detector))
    specs = [*(of_one(number) for number in range(8)), of_pairs(50, 70), of_pairs(20, 40)]
    rules = [
        {**head, "kind": "EventRule", "metadata": {"name": f"rule-{number}"}, "spec": spec}
        for number, spec in enumerate(specs)
    ]
    (folder / "rules.yaml").write_text(yaml.safe_dump_all(rules))


def messages(vehicles: int, seconds: int) -> Iterator[tuple[int, str, dict[str, object]]]:
    """Time, key and value of each message."""
    for step in range(seconds * HZ):
        at = step / HZ
        for car in range(vehicles):
            phase = car * 0.7
            value = {
                "x": round(300 * math.cos(at * 0.05 + phase) + 20 * car, 3),
                "y": round(200 * math.sin(at * 0.04 + phase * 1.3), 3),
                "speed": round(15 + 8 * math.sin(at * 0.11 + phase) + 0.3 * math.sin(at * 1.7), 3),
                "brake": math.sin(at * 0.3 + phase) > 0.9,
            }
            yield START + step * 10**9 // HZ, f"vehicles/car{car}/odom", value


def of_one(number: int) -> dict[str, object]:
    """A rule about each vehicle."""
    speed = {"name": "speed", "stream": "odom", "value": "msg.speed"}
    signals: list[dict[str, str]] = [speed, {"name": "braking", "stream": "odom", "value": "msg.brake"}]
    when, until = f"speed > {20 + number * 0.5}", "speed < 14"
    if number % 2:
        signals.append({**speed, "name": "top", "over": f"{number}s", "aggregate": "Max"})
        when, until = f"top - speed > {number * 0.8:g}", "top - speed < 0.2 || braking"
    return {"evaluation": {"every": "100ms"}, "signals": signals, "when": when, "until": until}


def of_pairs(near: float, far: float) -> dict[str, object]:
    """A rule about pairs of vehicles."""
    position = {"stream": "odom", "x": "msg.x", "y": "msg.y"}
    return {
        "evaluation": {"every": "200ms"},
        "scope": {"pairs": {"position": position, "within": 120}},
        "when": f"distance < {near}",
        "until": f"distance > {far}",
    }


if __name__ == "__main__":
    sys.exit(main())
