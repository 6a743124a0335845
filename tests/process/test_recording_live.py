"""Recordings and database of a running detector hold exactly the samples of their windows, as they were published."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from detector.engine.samples.sample import Arrival
from detector.replay.intake_file import read_intake
from detector.streams.codecs.cdr import CdrDecoder
from tests import programs
from tests.driving import a_rule, a_stream
from tests.mongodb.proxy import ServerProxy
from tests.patience import PATIENCE
from tests.process.database_harness import wait_until
from tests.process.running import Process
from tests.recording_bench import Recorded, mcap_files, read_with_mcap, read_with_rosbags, seconds
from tests.ros_messages import cdr, point_cloud
from wayside.api import EventRule
from wayside.times import parse_time

STREAMS = (
    a_stream("speed", stamp="msg.t"),
    a_stream("points", encoding="cdr", type="sensor_msgs/msg/PointCloud2"),
)
POINTS = CdrDecoder("sensor_msgs/msg/PointCloud2")
CLOUD = cdr(point_cloud(83_000))  # 1 MB; its stamp is in bytes 4:12
BEFORE, AFTER = 0.7, 0.5


def recording(name: str, when: str, database: str = "") -> EventRule:
    window = {"before": "700ms", "after": "500ms"}
    signals = [{"name": field, "stream": "speed", "value": f"msg.{field}"} for field in ("v", "w")]
    actions = [{"name": "bag", "record": window}]
    if database:
        actions.append({"name": "keep", "database": {"database": database, **window}})
    return a_rule(name, signals=signals, when=when, evaluation={"every": "100ms"}, actions=actions)


TURNS = {100: (0, 0), 150: (1, 0), 200: (1, 1), 240: (0, 1), 260: (0, 0), 300: (1, 0)}
"""Steps of the course at whose ends v or w passes its threshold, and whether they were over it until then."""


class Vehicle(threading.Thread):
    """Sends 100 messages a second and 10 clouds of 1 MB; every tenth message arrives after the next one.

    Its course has length `duration`. At a turn it continues as before until it is released, so the detector sees each
    step even on a slow machine.
    """

    def __init__(self, process: Process, name: str, duration: float, *, turns: bool = False) -> None:
        super().__init__(daemon=True)
        self._process, self._name, self._duration = process, name, duration
        self.sent: list[tuple[int, str, bytes]] = []
        """The stamp, key and payload."""
        self.free = 0 if turns else 2**31
        """The turn up to which it is released."""

    def run(self) -> None:
        begin, held = time.time(), None
        number, step, last = 0, 0, int(self._duration * 100)
        while step < last:
            due = begin + number / 100
            time.sleep(max(0.0, due - time.time()))
            at = step / 100
            # v is over its threshold in (1, 2] and again in (2.6, 3], w in (1.5, 2.4]
            value = {"v": int(1 < at <= 2 or 2.6 < at <= 3), "w": int(1.5 < at <= 2.4), "n": number, "t": round(due, 6)}
            step += step not in TURNS or step <= self.free
            payload = json.dumps(value).encode()
            if number % 10 == 3:
                held = payload
                number += 1
                continue
            self._put(round(due, 6), "speed", payload)
            if held is not None:
                self._put(json.loads(held)["t"], "speed", held)
                held = None
            if number % 10 == 0:
                stamp = divmod(round(due * 1e6) * 1000, 10**9)
                cloud = CLOUD[:4] + stamp[0].to_bytes(4, "little") + stamp[1].to_bytes(4, "little") + CLOUD[12:-8]
                self._put(due, "points", cloud + number.to_bytes(8, "little"))
            number += 1

    def _put(self, stamp: float, stream: str, payload: bytes) -> None:
        key = f"vehicles/{self._name}/{stream}"
        self.sent.append((round(stamp * 1e6) * 1000, key, payload))
        self._process.vehicle.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)


@pytest.fixture
def process(tmp_path: Path) -> Iterator[Process]:
    process = Process(tmp_path)
    yield process
    if process.process.poll() is None:
        process.stop()


def write(process: Process, *rules: EventRule, path: str = "recordings", **spec: Any) -> None:
    recordings = {"path": path, "reserve": "0", **spec.pop("recordings", {})}
    process.write(*rules, streams=STREAMS, recordings=recordings, **spec)


def finished(process: Process, count: int) -> list[Path]:
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        found = [each for each in process.folder.glob("recordings/*/*") if not each.name.startswith(".")]
        if len(found) >= count:
            return sorted(found)
        time.sleep(0.05)
    raise AssertionError(f"{[*process.folder.rglob('*')]}\n{(process.folder / 'log').read_text()}")


def follow(process: Process, *vehicles: Vehicle) -> None:
    """Releases each turn of the vehicles once the detector has seen the previous step; returns at their end."""
    for turn, over in TURNS.items():
        wanted = {name: len(vehicles) * is_over for name, is_over in zip(("v-rule", "w-rule"), over, strict=True)}
        process.status_when(
            lambda status, wanted=wanted: all(rule.open == wanted.get(rule.name, rule.open) for rule in status.rules)
        )
        for vehicle in vehicles:
            vehicle.free = turn
    for vehicle in vehicles:
        vehicle.join()


def until_written(process: Process, payload: bytes) -> None:
    """Wait until this payload, and so all data before it, is written to a recording in progress (uncompressed)."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if any(payload in each.read_bytes() for each in process.folder.glob("recordings/*/.*/*.mcap")):
            return
        time.sleep(0.05)
    raise AssertionError((process.folder / "log").read_text())


def stored(process: Process, database: Any, scenario: dict[str, Any]) -> list[Recorded]:
    """The stored documents of a scenario; of a cloud only the points, from its file."""
    found = []
    for collection in scenario["messages"]:
        for document in database[collection].find({"scenario": scenario["_id"]}):
            if document["stream"] == "points":
                file = (process.folder / "files" / document["msg"]["data"]["file"]).read_bytes()
                message = file.partition(b"DATA binary\n")[2]
            else:
                message = json.dumps({field: document["msg"][field] for field in "vwnt"}).encode()
            found.append(Recorded(f"/{document['key']}", seconds(document["time"]), message))
    return found


def as_stored(message: Recorded) -> Recorded:
    """The same for a recorded message: whole numbers are doubles in the database."""
    if message.topic.endswith("points"):
        return message._replace(payload=POINTS.decode(message.payload)["data"])
    values = json.loads(message.payload)
    return message._replace(payload=json.dumps({field: float(values[field]) for field in "vwnt"}).encode())


@pytest.mark.parametrize("clock", ["Wall", "Data"])
def test_overlapping_episodes_have_exactly_their_samples_in_recordings_and_in_the_database(
    process: Process, clock: str, proxy: ServerProxy, name: str, database: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TEST_MONGODB_URI", proxy.uri)
    spec = {"clock": "Data", "lateness": "3s", "maxAhead": "10s"} if clock == "Data" else {}
    spec["database"] = {
        "uriVariable": "TEST_MONGODB_URI",
        "spool": {"path": "spool", "bytes": "2Gi"},
        "files": {"path": "files"},
    }
    write(process, recording("v-rule", "v > 0", name), recording("w-rule", "w > 0", name), **spec)
    process.start("--record-intake", "intake")
    # With clock Data, only the stamps count: a late evaluation does not matter.
    duration = 7.5 if clock == "Data" else 4.5
    vehicles = [Vehicle(process, name, duration, turns=clock == "Wall") for name in ("car1", "car2")]
    for vehicle in vehicles:
        vehicle.start()
    if clock == "Wall":
        follow(process, *vehicles)
    for vehicle in vehicles:
        vehicle.join()
    bags = finished(process, 6)  # two episodes of v and one of w for each vehicle
    wait_until(lambda: database["Scenarios"].count_documents({"state": "Complete"}) == 6, PATIENCE)
    assert process.stop() == 0
    scenarios = {each["episode"]: each for each in database["Scenarios"].find()}
    arrivals = [each for each in read_intake(process.folder / "intake") if isinstance(each, Arrival)]
    sent = {(key, payload): stamp for vehicle in vehicles for stamp, key, payload in vehicle.sent}
    assert {(each.key, each.payload) for each in arrivals} == set(sent)
    compared = 0
    for bag in bags:
        reported = json.loads((bag / "recording.json").read_text())
        assert "cut" not in reported, reported
        begin = parse_time(reported["onsetTime"]) - int(BEFORE * 1e9)
        end = parse_time(reported["endTime"]) + int(AFTER * 1e9)
        (client,) = reported["subjects"]
        window = []
        for each in arrivals:
            at = each.received if clock == "Wall" else sent[each.key, each.payload]
            if f"/{client}/" in each.key and begin < at <= end:
                window.append(Recorded(f"/{each.key}", seconds(at), each.payload))
        found = [each for file in mcap_files(bag) for each in read_with_mcap(file)]
        assert sorted(found) == sorted(window)
        assert sorted(read_with_rosbags(bag)) == sorted(each for each in window if each.topic.endswith("points"))
        in_the_database = stored(process, database, scenarios[reported["episode"]])
        assert sorted(in_the_database) == sorted(as_stored(each) for each in window)
        compared += len(window)
    assert compared > 6 * 100
    assert clips_of(process) == {bag.name: contents(bag) for bag in bags}


def contents(recording: Path) -> tuple[Any, list[Recorded]]:
    """The description of a recording, and its messages."""
    reported = json.loads((recording / "recording.json").read_text())
    return reported, sorted(each for file in mcap_files(recording) for each in read_with_mcap(file))


def clips_of(process: Process) -> dict[str, tuple[Any, list[Recorded]]]:
    """The clips that a replay extracts from the recorded intake."""
    command = ["detector", "replay", "intake", "--output", "replayed", "--record"]
    replay = programs.Program(command, process.folder / "replay.log", folder=process.folder)
    assert replay.wait(PATIENCE) == 0, (process.folder / "replay.log").read_text()
    return {clip.name: contents(clip) for clip in process.folder.glob("replayed/clips/*/*")}


def test_a_killed_detector_keeps_its_recording_and_continues_in_another_one(process: Process) -> None:
    write(process, recording("v-rule", "v > -1"), state={"path": "state"})
    process.start()
    vehicle = Vehicle(process, "car1", 3)
    vehicle.start()
    vehicle.join()
    process.status_when(lambda status: status.streams[1].samples >= 25 and bool(status.rules[0].open))
    until_written(process, vehicle.sent[-1][2])
    process.process.send_signal(signal.SIGKILL)
    process.process.wait()
    process.vehicle.close()  # type: ignore[no-untyped-call]
    assert [each.name[0] for each in process.folder.glob("recordings/*/*")] == ["."]
    process.start()
    (cut,) = finished(process, 1)
    assert cut.name.endswith("_cut")
    found = sorted((each.topic, each.payload) for file in mcap_files(cut) for each in read_with_mcap(file))
    published = sorted((f"/{key}", payload) for _, key, payload in vehicle.sent)
    assert found == published
    process.send("car1", {"v": -5, "w": 0, "t": 1.0})
    bags = finished(process, 2)
    (more,) = (each for each in bags if each.name.endswith("_continued"))
    assert json.loads((more / "recording.json").read_text())["continued"] is True


def test_a_full_disk_ends_the_recording_but_not_the_events(process: Process) -> None:
    disk = process.folder / "recordings"
    disk.mkdir()
    mount = f"mount -t tmpfs -o size=6m tmpfs {disk}"
    if os.geteuid() != 0 or os.system(mount):
        pytest.skip("a disk of its own needs root")
    try:
        write(
            process,
            recording("v-rule", "v > 0"),
            a_rule(
                "silent",
                when="v > 0",
                signals=[{"name": "v", "stream": "speed", "value": "msg.v"}],
                evaluation={"every": "100ms"},
            ),
        )
        process.start()
        vehicle = Vehicle(process, "car1", 4, turns=True)
        vehicle.start()
        follow(process, vehicle)
        status = process.status_when(lambda status: any(each.failed for each in status.actions))
        (action,) = status.actions
        assert "spec.recordings.reserve" in action.last_failure
        process.status_when(lambda status: sum(each.ended for each in status.rules if each.name == "silent") == 2)
        for bag in finished(process, 1):
            assert all(read_with_mcap(file) for file in mcap_files(bag))
        assert process.stop() == 0
    finally:
        os.system(f"umount --lazy {disk}")
