"""The rule's classification is in all messages of a running detector about an episode."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.driving import a_deploy, a_rule, a_stream
from tests.mongodb.proxy import ServerProxy
from tests.patience import PATIENCE
from tests.process.database_harness import wait_until
from tests.process.running import Process
from tests.recording_bench import mcap_files, metadata_of

GIVEN = {"overarchingPurpose": ["Safety"], "incidence": ["Rare"], "typeOfAction": ["DataCollection", "Deployment"]}


@pytest.fixture
def process(tmp_path: Path, proxy: ServerProxy, monkeypatch: pytest.MonkeyPatch) -> Iterator[Process]:
    monkeypatch.setenv("TEST_MONGODB_URI", proxy.uri)
    process = Process(tmp_path)
    yield process
    assert process.stop() == 0


def tasks_in(folder: Path) -> list[dict[str, Any]]:
    """The tasks in the folder, without incomplete files, whose names begin with a dot."""
    return [
        task
        for path in folder.rglob("[!.]*.yaml")
        for task in yaml.safe_load_all(path.read_text())
        if task and task["kind"] == "ApplicationTask"
    ]


def test_events_recordings_scenarios_tasks_and_notifications_have_the_classification(
    process: Process, name: str, database: Any
) -> None:
    rule = a_rule(
        "r",
        classification=GIVEN,
        signals=[{"name": "v", "stream": "speed", "value": "msg.v"}],
        when="v > 10",
        evaluation={"every": "100ms"},
        actions=[
            {"name": "bag", "record": {"before": "1m"}},
            {"name": "keep", "database": {"database": name, "before": "1m"}},
            {"name": "notify", "notify": {"zenoh": {"key": "notices"}}},
            a_deploy("start"),
        ],
    )
    process.write(
        rule,
        streams=(a_stream("speed"),),
        recordings={"path": str(process.folder / "recordings"), "reserve": "0"},
        database={"uriVariable": "TEST_MONGODB_URI", "spool": {"path": str(process.folder / "spool"), "bytes": "64Mi"}},
    )
    process.start()
    notices: list[dict[str, Any]] = []
    listening = process.vehicle.declare_subscriber(
        "notices", lambda sample: notices.append(json.loads(sample.payload.to_bytes()))
    )
    process.send("car1", {"v": 20})
    process.status_when(lambda status: status.rules[0].open == 1)
    process.send("car1", {"v": 0})
    wait_until(lambda: [each["state"] for each in database["Scenarios"].find()] == ["Complete"], PATIENCE)
    wait_until(lambda: len(list(process.folder.glob("recordings/*/[!.]*/recording.json"))) == 1, PATIENCE)
    wait_until(lambda: len(notices) == 2, PATIENCE)
    listening.undeclare()

    events = process.events_when(2)
    assert [each["data"]["classification"] for each in events] == [GIVEN, GIVEN]
    assert [each["data"]["classification"] for each in notices] == [GIVEN, GIVEN]
    (folder,) = (path.parent for path in process.folder.glob("recordings/*/[!.]*/recording.json"))
    assert json.loads((folder / "recording.json").read_text())["classification"] == GIVEN
    (file,) = mcap_files(folder)
    assert GIVEN in [json.loads(each.get("classification", "null")) for each in metadata_of(file).values()]
    (scenario,) = database["Scenarios"].find()
    assert scenario["classification"] == GIVEN
    wait_until(lambda: bool(tasks_in(process.folder / "out")), PATIENCE)
    tasks = tasks_in(process.folder / "out")
    assert all(each["spec"]["event"]["classification"] == GIVEN for each in tasks)
