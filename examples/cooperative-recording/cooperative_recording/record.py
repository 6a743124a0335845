"""The drive as a recording: an MCAP file as `ros2 bag record -s mcap` writes it, made at once."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from mcap.writer import Writer

from cooperative_recording.messages import POINTS_TYPE, POSE_TYPE, TYPESTORE, messages
from cooperative_recording.vehicles import Drive

START_NS = int(datetime(2026, 1, 1, tzinfo=UTC).timestamp()) * 10**9
"""The default stamp of a recording's second 0."""


def record(drive: Drive, path: Path, duration_s: float, start_ns: int = START_NS) -> int:
    """Write the drive's first duration_s seconds to the file, replacing it, and return how many messages it holds.

    Log times, publish times and stamps are the same. A topic is the Zenoh key with a slash before it.

    Raises:
        OSError: the file cannot be written.
    """
    count = 0
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="wayside cooperative-recording")
        schemas = {
            name: writer.register_schema(name, "ros2msg", TYPESTORE.generate_msgdef(name, ros_version=2)[0].encode())
            for name in (POSE_TYPE, POINTS_TYPE)
        }
        channels: dict[str, int] = {}
        for message in messages(drive, start_ns, duration_s):
            if message.key not in channels:
                metadata = {"offered_qos_profiles": ""}
                channels[message.key] = writer.register_channel(
                    f"/{message.key}", "cdr", schemas[message.type], metadata
                )
            moment = start_ns + message.after_ns
            writer.add_message(channels[message.key], moment, message.payload, moment)
            count += 1
        writer.finish()  # type: ignore[no-untyped-call]
    return count
