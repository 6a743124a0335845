"""`detector run` with a database: it has the recording's samples; after kill -9 no incomplete scenario is complete."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from detector.status.model import RuleStatus
from detector.streams.codecs.cdr import CdrDecoder
from tests.driving import a_rule, a_stream
from tests.mongodb.proxy import ServerProxy
from tests.patience import PATIENCE
from tests.process.database_harness import spooled, wait_until
from tests.process.running import Process
from tests.recording_bench import mcap_files, read_with_mcap
from tests.ros_messages import cdr, point_cloud

CLOUDS = a_stream("points", encoding="cdr", type="sensor_msgs/msg/PointCloud2")
READ = CdrDecoder("sensor_msgs/msg/PointCloud2")
FAST = {"name": "v", "stream": "speed", "value": "msg.v"}
EVERY = {"every": "100ms"}


@pytest.fixture
def process(tmp_path: Path, proxy: ServerProxy, monkeypatch: pytest.MonkeyPatch) -> Iterator[Process]:
    monkeypatch.setenv("TEST_MONGODB_URI", proxy.uri)
    process = Process(tmp_path)
    yield process
    assert process.stop() == 0


def a_cloud() -> bytes:
    """A unique message of about 1 MB."""
    message = point_cloud(87_000)
    message.data[:] = np.frombuffer(os.urandom(message.data.size), np.uint8)
    return cdr(message)


def place(process: Process) -> dict[str, Any]:
    return {
        "database": {
            "uriVariable": "TEST_MONGODB_URI",
            "spool": {"path": str(process.folder / "spool"), "bytes": "256Mi"},
            "files": {"path": str(process.folder / "files")},
        },
        "recordings": {"path": str(process.folder / "recordings"), "reserve": "0"},
        "state": {"path": str(process.folder / "state")},
    }


def scenarios(database: Any) -> dict[str, dict[str, Any]]:
    return {each["_id"]: each for each in database["Scenarios"].find()}


def test_the_database_has_the_samples_that_the_recording_has(process: Process, name: str, database: Any) -> None:
    window = {"before": "1m", "after": "200ms"}
    actions = [
        {"name": "bag", "record": window},
        {"name": "keep", "database": {"database": name, "metadata": {"who": "${client}"}, **window}},
    ]
    one = a_rule("one", signals=[FAST], when="v > 10", evaluation=EVERY, actions=actions)
    two = a_rule("two", signals=[FAST], when="v > 20", evaluation=EVERY, actions=actions)
    streams = (a_stream("speed"), CLOUDS)
    process.write(one, two, streams=streams, **place(process))
    process.start()
    for number in range(300):
        v = 0 if number < 100 or number >= 250 else 15 if number < 150 else 25
        process.send("car1", {"v": v, "n": number})
        process.send("car2", {"v": 0, "n": number})
        if number % 30 == 0:
            process.send("car1", a_cloud(), "points")
        if number in (100, 150):  # so that each rule evaluates it
            wanted = 1 if number == 100 else 2
            process.status_when(lambda status, wanted=wanted: sum(r.open for r in status.rules) == wanted)
    wait_until(lambda: [each["state"] for each in scenarios(database).values()] == ["Complete"] * 2, PATIENCE)
    bags = process.folder / "recordings"  # each action has its own thread
    wait_until(lambda: len(list(bags.glob("*/[!.]*/metadata.yaml"))) == 2, PATIENCE)
    for each in scenarios(database).values():
        assert each["metadata"] == {"who": "car1"}
        (folder,) = [path.parent for path in bags.glob("*/[!.]*/metadata.yaml") if each["episode"] in path.read_text()]
        recorded = {message for file in mcap_files(folder) for message in read_keys(file)}
        written = {
            (document["key"], payload_of(process, document))
            for collection in each["messages"]
            for document in database[collection].find({"scenario": each["_id"]})
        }
        assert written == recorded
        assert len(written) == sum(each["messages"].values()) > 100
        assert each["clients"] == ["car1"]


def payload_of(process: Process, document: dict[str, Any]) -> Any:
    if document["stream"] == "points":
        file = (process.folder / "files" / document["msg"]["data"]["file"]).read_bytes()
        head, _, points = file.partition(b"DATA binary\n")
        assert b"FIELDS x y z" in head
        return points
    return (document["msg"]["v"], document["msg"]["n"])


def read_keys(file: Path) -> list[tuple[str, Any]]:
    return [
        (
            each.topic.lstrip("/"),
            READ.decode(each.payload)["data"]
            if each.topic.endswith("points")
            else tuple(json.loads(each.payload).values()),
        )
        for each in read_with_mcap(file)
    ]


BOUTS = (0, 20) * 5
"""Speeds that cross the threshold repeatedly, for many episodes; the last one stays open."""


class Drive:
    """Two clients that send their speeds to a process, in samples numbered from `first`."""

    def __init__(self, process: Process, first: int = 0) -> None:
        self._process = process
        self._first = self._number = first

    def send(self, *speeds: int) -> None:
        """Send twenty samples of each speed for each client."""
        for v in speeds:
            for _ in range(20):
                for client in ("car1", "car2"):
                    self._process.send(client, {"v": v, "n": self._number, "pad": "x" * 500})
                self._number += 1

    def send_until(self, true: Callable[[RuleStatus], bool], *speeds: int) -> None:
        """Send these until `true` holds for the rule: samples during a stall of a second start no episode."""

        def sent() -> bool:
            self.send(*speeds)
            count = 2 * (self._number - self._first)
            return true(self._process.status_when(lambda status: status.streams[0].samples == count).rules[0])

        wait_until(sent, PATIENCE)


def check(database: Any) -> int:
    """The number of scenarios marked as complete; checks that each one is complete."""
    complete = [each for each in scenarios(database).values() if each["complete"]]
    written: dict[str, list[float]] = {}
    for document in database["json/speed"].find():
        written.setdefault(document["scenario"], []).append(document["msg"]["n"])
    for each in complete:
        numbers = sorted(written[each["_id"]])
        assert len(numbers) == sum(each["messages"].values())
        assert numbers == list(range(int(numbers[0]), int(numbers[0]) + len(numbers)))
    return len(complete)


@pytest.mark.parametrize("away", [False, True])
def test_after_kill_9_every_scenario_marked_complete_is_complete(
    process: Process, name: str, database: Any, proxy: ServerProxy, *, away: bool
) -> None:
    keep = {"name": "keep", "database": {"database": name, "before": "20ms", "after": "20ms"}}
    rule = a_rule("bout", signals=[FAST], when="v > 10", evaluation={"onSample": "speed"}, actions=[keep])
    process.write(rule, streams=(a_stream("speed"),), **place(process))
    process.start()
    drive = Drive(process)
    drive.send_until(lambda rule: rule.started > 2, *BOUTS)
    if away:
        wait_until(lambda: check(database) > 0, PATIENCE)
        proxy.cut()
        drive.send_until(lambda rule: rule.started > 12, *BOUTS)
        wait_until(lambda: spooled(process.folder / "spool") > 0, PATIENCE)
    else:
        wait_until(lambda: database["json/speed"].count_documents({}) > 20, PATIENCE)
        drive.send(0, 20)
    process.process.kill()
    process.process.wait()
    process.vehicle.close()  # type: ignore[no-untyped-call]
    proxy.restore()
    before = check(database)
    process.start()
    drive = Drive(process, first=100_000)
    drive.send_until(lambda rule: rule.started > 2, *BOUTS)
    drive.send_until(lambda rule: rule.open == 0, 0)

    def settled() -> bool:
        found = scenarios(database).values()
        return all(each["state"] != "Open" for each in found) and check(database) > before

    wait_until(settled, PATIENCE, pause=0.3)
    states = {each["state"] for each in scenarios(database).values()}
    assert "Complete" in states
    assert {each["complete"] for each in scenarios(database).values() if each["state"] != "Complete"} <= {False}
