"""The live view of a running detector, seen by an independent client."""

from __future__ import annotations

import json
import struct
import time
from bisect import bisect_right
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from mcap.reader import make_reader
from websockets.sync.client import ClientConnection, connect

from tests import programs
from tests.driving import a_rule, a_stream
from tests.patience import PATIENCE
from tests.ports import free_port
from tests.process.running import Process

PROTOCOL: Any = "foxglove.sdk.v1"
FAST = a_rule(
    "fast",
    signals=[{"name": "v", "stream": "speed", "value": "msg.v"}, {"name": "gear", "stream": "speed", "value": "msg.g"}],
    when="v > 10",
    until="v < 5",
    evaluation={"every": "100ms"},
)
NEAR = a_rule(
    "near",
    scope={"pairs": {"position": {"stream": "speed", "x": "msg.v", "y": "0.0"}, "within": 50}},
    when="distance < 5",
    evaluation={"every": "100ms"},
)
FLEET = a_rule(
    "any-fast",
    scope={"fleet": {"members": "true"}},
    signals=[{"name": "v", "stream": "speed", "value": "msg.v"}],
    when="members.exists(m, m.v > 10)",
    evaluation={"every": "100ms"},
)
ALONE = a_rule(
    "aged",
    signals=[{"name": "age", "stream": "speed", "aggregate": "Age", "where": "msg.v > 0"}],
    when="age > 100",
    evaluation={"every": "100ms"},
)
"""A condition that cannot be evaluated in columns."""
SUBJECTS = {
    *(f"/wayside/fast/{car}" for car in ("car1", "car2")),
    *(f"/wayside/aged/{car}" for car in ("car1", "car2")),
    "/wayside/near/car1+car2",
    "/wayside/any-fast/~fleet",
}
OTHERS = {"/wayside/episodes", "/wayside/log", "/wayside/scene"}


class Shown(NamedTuple):
    time: int
    value: dict[str, Any]


class Viewer:
    """A client of the protocol that uses only a WebSocket."""

    def __init__(self, port: int) -> None:
        self._socket: ClientConnection = connect(f"ws://127.0.0.1:{port}", subprotocols=[PROTOCOL])
        self.channels: dict[str, dict[str, Any]] = {}
        self.messages: dict[str, list[tuple[int, bytes]]] = {}
        self._topics: list[str] = []

    def close(self) -> None:
        self._socket.close()

    def take(self, timeout: float = 0.05) -> None:
        """Receive the next message, if one arrives in time."""
        try:
            message = self._socket.recv(timeout)
        except TimeoutError:
            return
        if isinstance(message, str):
            reported = json.loads(message)
            for channel in reported.get("channels", ()) if reported["op"] == "advertise" else ():
                self.channels[channel["topic"]] = channel
            return
        opcode, subscription, stamp = struct.unpack_from("<BIQ", message)
        if opcode == 1:
            self.messages.setdefault(self._topics[subscription], []).append((stamp, message[13:]))

    def subscribe(self, *topics: str) -> None:
        chosen = []
        for topic in topics:
            chosen.append({"id": len(self._topics), "channelId": self.channels[topic]["id"]})
            self._topics.append(topic)
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": chosen}))

    def shown(self, topic: str) -> list[Shown]:
        return [Shown(at, json.loads(payload)) for at, payload in self.messages.get(topic, ())]


class Watched(NamedTuple):
    process: Process
    port: int


@pytest.fixture
def watched(tmp_path: Path) -> Iterator[Watched]:
    process, port = Process(tmp_path), free_port()
    process.write(FAST, NEAR, FLEET, ALONE, streams=(a_stream("speed"),))
    process.start("--foxglove", str(port), "--record-intake", "intake")
    yield Watched(process, port)
    if process.process.poll() is None:
        process.stop()


def drive(watched: Watched, viewer: Viewer, done: Any) -> None:
    """Drive two cars until the wanted messages have arrived; one value is absent at times."""
    step, end = 0, time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < end, (viewer.channels.keys(), {t: len(m) for t, m in viewer.messages.items()})
        for number, car in enumerate(("car1", "car2")):
            value = {"v": (step * 0.7 + number * 3) % 17, "g": "D" if step % 20 < 15 else None}
            watched.process.send(car, {name: each for name, each in value.items() if each is not None})
        step += 1
        viewer.take()


def listens_on(port: int) -> set[str]:
    """The addresses on which this port is served, in the kernel's hexadecimal form."""
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            local, state = line.split()[1], line.split()[3]
            address, _, number = local.partition(":")
            if state == "0A" and int(number, 16) == port:
                found.add(address)
    return found


def test_the_live_view_shows_the_results_of_the_replay(watched: Watched) -> None:
    process, viewer = watched.process, Viewer(watched.port)
    assert listens_on(watched.port) == {"0100007F"}  # 127.0.0.1 alone
    drive(watched, viewer, lambda: viewer.channels.keys() >= SUBJECTS | OTHERS)
    viewer.subscribe(*SUBJECTS, *OTHERS)
    enough = SUBJECTS | {"/wayside/scene"}
    drive(watched, viewer, lambda: all(len(viewer.messages.get(topic, ())) >= 20 for topic in enough))
    drive(watched, viewer, lambda: len(viewer.messages.get("/wayside/episodes", ())) >= 4)
    viewer.close()
    assert process.stop() == 0
    command = ["detector", "replay", "intake", "--output", "replayed", "--results", "mcap"]
    replay = programs.Program(command, process.folder / "replay.log", folder=process.folder)
    assert replay.wait(PATIENCE) == 0, (process.folder / "replay.log").read_text()
    recorded: dict[str, list[Shown]] = {}
    with (process.folder / "replayed/results.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            if channel.message_encoding == "json":
                recorded.setdefault(channel.topic, []).append(Shown(message.log_time, json.loads(message.data)))
    for topic in SUBJECTS:
        in_file, live = recorded[topic], viewer.shown(topic)
        times = [each.time for each in in_file]
        for each in live:
            assert plain(each.value) == plain(in_file[bisect_right(times, each.time) - 1].value), (topic, each.time)
        seen = {each.time for each in live}
        changes = {time for time in times if live[0].time <= time <= live[-1].time}
        assert changes <= seen, f"{topic}: {len(changes - seen)} of {len(changes)} changes were not shown"
    episodes = viewer.shown("/wayside/episodes")
    assert episodes
    assert {json.dumps(each) for each in episodes} <= {json.dumps(each) for each in recorded["/wayside/episodes"]}
    assert viewer.channels["/wayside/scene"]["schemaName"] == "foxglove.SceneUpdate"


def plain(message: dict[str, Any]) -> dict[str, Any]:
    """The message without the reasons, which contain ages."""
    return {name: value for name, value in message.items() if not name.endswith("_reason")}
