"""Recordings: a scenario's messages as an MCAP file, and what a record action has written."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path
from typing import NamedTuple

from mcap.reader import SeekingReader
from mcap.writer import Writer

from examples.running.ros import TYPESTORE
from examples.running.scenario import SECOND, START_NS, Message


class Recorded(NamedTuple):
    """A message in a recording."""

    after_ns: int
    key: str
    payload: bytes


def write_recording(messages: Iterable[Message], path: Path) -> int:
    """Write the messages in the order of time, as `detector replay` reads them; gives how many there are.

    Log time, publish time and stamp are the same; a topic is the Zenoh key with a slash before it.

    Raises:
        OSError: the file cannot be written.
    """
    count = 0
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="wayside examples")
        schemas: dict[str, int] = {"": 0}
        channels: dict[str, int] = {}
        for message in sorted(messages, key=lambda each: (each.after_ns, each.key)):
            if message.type not in schemas:
                definition = TYPESTORE.generate_msgdef(message.type, ros_version=2)[0]
                schemas[message.type] = writer.register_schema(message.type, "ros2msg", definition.encode())
            if message.key not in channels:
                channels[message.key] = writer.register_channel(
                    f"/{message.key}", message.encoding, schemas[message.type]
                )
            moment = START_NS + message.after_ns
            writer.add_message(channels[message.key], moment, message.payload, moment)
            count += 1
        writer.finish()  # type: ignore[no-untyped-call]
    return count


def read_recording(path: Path) -> list[Recorded]:
    """The messages of an MCAP file or of all MCAP files in a folder, by time and key."""
    found = []
    for each in sorted(path.glob("*.mcap")) if path.is_dir() else [path]:
        with each.open("rb") as file:
            found += [
                Recorded(message.log_time - START_NS, channel.topic.removeprefix("/"), message.data)
                for _, channel, message in SeekingReader(file).iter_messages()
            ]
    return sorted(found)


def within(messages: Iterable[Message], clients: Collection[str], first_s: float, last_s: float) -> list[Message]:
    """The messages of these clients that were sent after `first_s`, and until `last_s` at the latest."""
    return [
        each for each in messages
        if each.key.split("/")[1] in clients and first_s * SECOND < each.after_ns <= last_s * SECOND
    ]  # fmt: skip


def missing_messages(expected: Iterable[Message], found: Iterable[Recorded], what: str) -> list[str]:
    """The difference between recorded and expected messages: a line, or none."""
    must = sorted(Recorded(each.after_ns, each.key, each.payload) for each in expected)
    there = sorted(found)
    if must == there:
        return []
    missing, extra = len(set(must) - set(there)), len(set(there) - set(must))
    return [f"{what}: {len(there)} messages, {len(must)} expected; {missing} are missing, {extra} are too many"]
