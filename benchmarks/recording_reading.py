"""How many messages a second are read from recordings, up to what the engine takes, beside plain readers.

MCAP files hold poses on a hundred topics, uncompressed and with zstd; the plain reader is that of the library mcap.
JSON lines hold small values; the plain reader is `json.loads` for each line. Rounds alternate; of each, the fastest
counts, in processor time.

    python benchmarks/recording_reading.py [--messages 200000] [--rounds 5]
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from mcap.reader import SeekingReader
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from detector.assembly.memory import tune_garbage_collection
from detector.replay.recordings import open_recordings
from detector.replay.routing import MessageRouter
from wayside.api.stream import Encoding, Stream

TARGET = {"MCAP": 1_500_000, "JSON lines": 1_000_000}
TOPICS = 100
START = 1_767_225_600_000_000_000
STEP = 100_000
"""Nanoseconds between two messages."""
POSE = "geometry_msgs/msg/PoseStamped"


def pose() -> bytes:
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="map")
    place = types["geometry_msgs/msg/Point"](x=1.0, y=2.0, z=3.0)
    turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    message = types[POSE](header=header, pose=types["geometry_msgs/msg/Pose"](position=place, orientation=turn))
    return bytes(store.serialize_cdr(message, POSE))


def write_mcap(path: Path, messages: int, compression: CompressionType) -> Path:
    payload = pose()
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start()
        schema = writer.register_schema(POSE, "ros2msg", b"")
        channels = [writer.register_channel(f"/vehicles/car{n}/pose", "cdr", schema) for n in range(TOPICS)]
        for number in range(messages):
            when = START + number * STEP
            writer.add_message(channels[number % TOPICS], when, payload, when)
        writer.finish()
    return path


def write_lines(path: Path, messages: int) -> Path:
    with path.open("w", encoding="utf-8") as file:
        for number in range(messages):
            value = {"v": number % 30 + 0.5, "heading": 90.0}
            line = {"t": START + number * STEP, "key": f"vehicles/car{number % TOPICS}/speed", "value": value}
            file.write(json.dumps(line) + "\n")
    return path


def arrivals_in(path: Path) -> int:
    router = MessageRouter(
        [
            Stream(name="pose", key="vehicles/${client:*}/pose", encoding=Encoding.CDR, type=POSE),
            Stream(name="speed", key="vehicles/${client:*}/speed", encoding=Encoding.JSON),
        ]
    )
    return sum(len(arrivals) for arrivals in router.arrivals(open_recordings([path], router.wanted)))


def messages_of_mcap(path: Path) -> int:
    with path.open("rb") as file:
        return sum(1 for _ in SeekingReader(file, validate_crcs=True).iter_messages())


def messages_of_lines(path: Path) -> int:
    with path.open("rb") as file:
        return sum(1 for line in file if json.loads(line))


def rate(read: Callable[[Path], int], path: Path, messages: int) -> float:
    """Messages a second of processor time."""
    begin = time.process_time()
    found = read(path)
    seconds = time.process_time() - begin
    assert found == messages, (read.__name__, path, found)
    return messages / seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--messages", type=int, default=200_000)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    tune_garbage_collection()  # as the command does
    with tempfile.TemporaryDirectory() as folder:
        cases = [
            (
                f"MCAP {compression.name.lower()}",
                write_mcap(Path(folder) / f"{compression.name}.mcap", options.messages, compression),
                messages_of_mcap,
            )
            for compression in (CompressionType.NONE, CompressionType.ZSTD)
        ]
        cases.append(("JSON lines", write_lines(Path(folder) / "drive.jsonl", options.messages), messages_of_lines))
        best: dict[tuple[str, str], float] = {}
        for _ in range(options.rounds):
            for name, path, plain in cases:
                for kind, read in (("arrivals", arrivals_in), ("plain", plain)):
                    found = rate(read, path, options.messages)
                    best[name, kind] = max(found, best.get((name, kind), 0.0))
    for name, _, _ in cases:
        ours, plain_rate = best[name, "arrivals"], best[name, "plain"]
        target = next(rate for kind, rate in TARGET.items() if name.startswith(kind))
        print(
            f"{name:10}: {ours / 1e6:.2f} M messages/s to arrivals, {ours / plain_rate:.1f} times the plain reader "
            f"({plain_rate / 1e3:.0f} k/s); target {target / 1e6:.1f} M/s {'kept' if ours >= target else 'MISSED'}"
        )


if __name__ == "__main__":
    main()
