"""The database is away for a minute under load: events and recordings continue, and its missing documents are
counted."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.driving import a_rule, a_stream
from tests.mongodb import MongoServer
from tests.mongodb.proxy import ServerProxy
from tests.patience import PATIENCE
from tests.process.database_harness import wait_until
from tests.process.running import Process
from tests.recording_bench import mcap_files, read_with_mcap

AWAY = 60.0
"""Seconds. At 100 Hz from two clients, this exceeds the memory and the smaller spool."""

CLIENTS = ("car1", "car2")
PADDING = "x" * 12_000


class RecordingDetector(Process):
    """A detector that writes each episode to a database and to a recording."""

    def __init__(self, folder: Path, database: Any, spool: str) -> None:
        folder.mkdir()
        super().__init__(folder)
        self.database = database
        window = {"before": "50ms", "after": "50ms"}
        rule = a_rule(
            "bout",
            signals=[{"name": "v", "stream": "speed", "value": "msg.v"}],
            when="v > 10",
            evaluation={"every": "100ms"},
            actions=[
                {"name": "bag", "record": window},
                {"name": "keep", "database": {"database": database.name, **window}},
            ],
        )
        self.write(
            rule,
            streams=(a_stream("speed"),),
            database={"uriVariable": "TEST_MONGODB_URI", "spool": {"path": "spool", "bytes": spool}},
            recordings={"path": "recordings", "reserve": "0"},
        )
        self.start()

    def episodes(self, kind: str) -> list[str]:
        """The ids of the episodes that have started or ended."""
        return [each["data"]["episode"] for each in self.written() if each["type"].endswith(kind)]

    def at_rest(self, samples: int) -> list[str]:
        """The ids of all episodes, once this number of samples was received and their results are in the file."""
        status = self.status_when(lambda status: status.streams[0].samples == samples and not status.rules[0].open)
        self.events_when(2 * status.rules[0].started)
        begun = self.episodes("started")
        assert sorted(begun) == sorted(self.episodes("ended"))
        return begun

    def scenarios(self) -> list[dict[str, Any]]:
        return list(self.database["Scenarios"].find())

    def recorded(self) -> dict[str, list[tuple[str, float]]]:
        """The keys and numbers of the recorded samples, by episode."""
        found = {}
        for reported in self.folder.glob("recordings/*/[!.]*/recording.json"):
            messages = [each for file in mcap_files(reported.parent) for each in read_with_mcap(file)]
            numbers = [(each.topic.lstrip("/"), float(json.loads(each.payload)["n"])) for each in messages]
            found[json.loads(reported.read_text())["episode"]] = sorted(numbers)
        return found

    def stored(self) -> dict[str, list[tuple[str, float]]]:
        """The same for the documents, by scenario; in one query, since each query reads all documents."""
        found: dict[str, list[tuple[str, float]]] = {}
        for each in self.database["json/speed"].find({}, {"scenario": 1, "key": 1, "msg.n": 1}):
            found.setdefault(each["scenario"], []).append((each["key"], each["msg"]["n"]))
        return {scenario: sorted(numbers) for scenario, numbers in found.items()}


@pytest.fixture
def pair(
    tmp_path: Path, proxy: ServerProxy, mongodb: MongoServer, database: Any, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[RecordingDetector, RecordingDetector]]:
    """One detector with a spool for everything, and one with a small spool."""
    monkeypatch.setenv("TEST_MONGODB_URI", proxy.uri)
    client = database.client
    ample = RecordingDetector(tmp_path / "ample", client[f"{database.name}a"], "2Gi")
    tight = RecordingDetector(tmp_path / "tight", client[f"{database.name}t"], "4Mi")
    yield ample, tight
    for each in (ample, tight):
        assert each.stop() == 0
        client.drop_database(each.database.name)


def drive(detectors: tuple[RecordingDetector, RecordingDetector], seconds: float) -> int:
    """Each client's speed crosses the threshold twice a second for most of the time; then all stand still.

    Returns the number of samples that each detector received.
    """
    begin = time.monotonic()
    for number in range(int(seconds * 100)):
        time.sleep(max(0.0, begin + number / 100 - time.monotonic()))
        value = {"v": 0 if number % 50 >= 40 else 20, "n": number, "pad": PADDING}
        for process in detectors:
            for client in CLIENTS:
                process.send(client, value)
    for process in detectors:
        for client in CLIENTS:
            process.send(client, {"v": 0, "n": -1})
    return len(CLIENTS) * (int(seconds * 100) + 1)


def test_a_minute_without_the_database_costs_neither_events_nor_recordings_and_every_loss_is_counted(
    pair: tuple[RecordingDetector, RecordingDetector], proxy: ServerProxy
) -> None:
    samples = drive(pair, 3)
    before = []
    for each in pair:
        before.append(len(each.at_rest(samples)))
        wait_until(lambda each=each: any(one["complete"] for one in each.scenarios()), PATIENCE)
    proxy.cut()
    samples += drive(pair, AWAY)
    for each, earlier in zip(pair, before, strict=True):
        begun = each.at_rest(samples)
        assert len(begun) - earlier > AWAY  # two clients, and a bout lasts half a second
        wait_until(lambda each=each, begun=begun: each.recorded().keys() == set(begun), 3 * PATIENCE, pause=1.0)
        assert not {one["episode"] for one in each.scenarios()} & set(begun[earlier:])
    proxy.restore()
    for each in pair:
        begun = each.episodes("started")

        def settled(each: RecordingDetector = each, begun: list[str] = begun) -> bool:
            there = each.scenarios()
            return {one["episode"] for one in there} == set(begun) and all(one["state"] != "Open" for one in there)

        wait_until(settled, 5 * PATIENCE, pause=1.0)
    ample, tight = pair
    recorded, stored = ample.recorded(), ample.stored()
    assert sum(len(numbers) for numbers in recorded.values()) > AWAY * 100
    for scenario in ample.scenarios():
        assert scenario["state"] == "Complete"
        assert stored[scenario["_id"]] == recorded[scenario["episode"]]
    recorded, stored, missing = tight.recorded(), tight.stored(), 0
    for scenario in tight.scenarios():
        wanted, found = recorded[scenario["episode"]], stored.get(scenario["_id"], [])
        assert len(set(found)) == len(found)
        assert set(found) <= set(wanted)
        assert scenario["complete"] == (found == wanted)
        assert scenario.get("missing", 0) == len(wanted) - len(found)
        missing += len(wanted) - len(found)
    assert missing > 0

    def reported() -> dict[str, float]:
        return {key[1]: value for key, value in tight.metrics().items() if key[0] == "action_missing_total"}

    wait_until(
        lambda: reported() == {"bag": 0, "keep": missing}, PATIENCE
    )  # reported once the database has the last document
