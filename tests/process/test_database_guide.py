"""The rules of docs/database.md work as described, and errors in one are reported with their place."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from detector.actions import DetectorConfiguration
from detector.actions.host import ActionHost
from detector.assembly import stream_readers
from detector.assembly.checking import findings
from tests.driving import a_detector, a_rule, a_stream, an_engine, arrival, at, compiled
from tests.mongodb.proxy import ServerProxy
from tests.process.database_harness import wait_until
from wayside.api import Detector, EventRule
from wayside.api.documents import DocumentError, load_documents

GUIDE = Path(__file__).parents[2].joinpath("docs", "database.md").read_text(encoding="utf-8")
EXAMPLES = [yaml.safe_load(block) for block in re.findall(r"^```yaml\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)]
DETECTOR, RECORD_ALL, THRESHOLD = EXAMPLES


def checked(tmp_path: Path, *objects: dict[str, Any]) -> list[str]:
    whole = [
        {"apiVersion": "wayside.dev/v1alpha1", "kind": each["kind"], "metadata": {"name": "d"}, **each}
        for each in objects
    ]
    (tmp_path / "all.yaml").write_text(yaml.safe_dump_all(whole, sort_keys=False))
    try:
        return [str(each) for each in findings(load_documents([tmp_path / "all.yaml"])).problems]
    except DocumentError as error:
        return [str(error)]


def test_the_examples_are_accepted(tmp_path: Path) -> None:
    assert checked(tmp_path, *EXAMPLES) == []


def test_a_database_action_without_a_database_in_the_detector_is_rejected_by_field(tmp_path: Path) -> None:
    without = {**DETECTOR, "spec": {"streams": DETECTOR["spec"]["streams"]}}
    (problem,) = checked(tmp_path, without, RECORD_ALL)
    logged = r"all\.yaml:\d+:\d+: spec\.actions\[0\]\.database: Detector d has no spec\.database: add it"
    assert re.search(logged, problem)


def test_an_action_with_files_needs_a_folder_in_the_detector(tmp_path: Path) -> None:
    without = {**DETECTOR, "spec": {**DETECTOR["spec"], "database": {"uriVariable": "MONGODB_URI"}}}
    rule = {**RECORD_ALL, "spec": {**RECORD_ALL["spec"], "actions": [{"name": "a", "database": {"files": {}}}]}}
    (problem,) = checked(tmp_path, without, rule)
    assert "spec.actions[0].database.files: Detector d has no spec.database.files: add it" in problem


@pytest.mark.parametrize(
    ("fields", "logged"),
    [
        ({"metadata": {"who": "${nobody}"}}, "nobody"),
        ({"metadata": {"who": "${client"}}, "who"),
        ({"database": "a/b"}, "database"),
        ({"files": {"above": "0"}}, "quantity above zero"),
        ({"streams": ["odometri"]}, "odometry"),
        ({"before": "1h"}, "exceeds the"),
    ],
)
def test_errors_of_a_database_action_are_reported_by_field(tmp_path: Path, fields: dict[str, Any], logged: str) -> None:
    action = {"name": "keep", "database": fields}
    problem, *_ = checked(tmp_path, DETECTOR, {**RECORD_ALL, "spec": {**RECORD_ALL["spec"], "actions": [action]}})
    assert re.search(r"all\.yaml:\d+:\d+: .*spec\.actions\[0\]\.database", problem)
    assert logged in problem


@pytest.mark.parametrize(
    ("database", "logged"),
    [
        ({}, "uriSecretName, uriVariable and uriFile"),
        ({"uriVariable": "A", "uriFile": "b"}, "uriSecretName, uriVariable and uriFile"),
        ({"uriVariable": "A", "writeConcern": "Two"}, "writeConcern"),
    ],
)
def test_errors_of_the_detectors_database_are_reported_by_field(
    tmp_path: Path, database: dict[str, Any], logged: str
) -> None:
    (tmp_path / "d.yaml").write_text(
        yaml.safe_dump({**a_detector().to_json(), "spec": {**a_detector().to_json()["spec"], "database": database}})
    )
    with pytest.raises(DocumentError, match=logged) as reported:
        load_documents([tmp_path / "d.yaml"])
    assert "d.yaml:" in str(reported.value)


def as_json(rule: dict[str, Any], database: str) -> EventRule:
    """The example's rule, for JSON streams of the same names and the test's own database."""
    spec = json.loads(json.dumps(rule["spec"]))
    for action in spec["actions"]:
        action["database"]["database"] = database
    return a_rule(rule["metadata"]["name"], **spec)


class Drive:
    """The engine and the actions as in `detector run`, with samples at given times."""

    def __init__(self, rule: EventRule, proxy: ServerProxy, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("MONGODB_GUIDE_URI", proxy.uri)
        streams = (a_stream("odometry"), a_stream("points", encoding="raw"))
        self.detector: Detector = a_detector(*streams, database={"uriVariable": "MONGODB_GUIDE_URI"})
        self.engine = an_engine(self.detector)
        self.engine.consequences.wanted = True
        self.published: list[dict[str, Any]] = []
        self.host = ActionHost("h", self, now=lambda: 0)
        readers = stream_readers(self.detector)
        self.host.follow([rule], DetectorConfiguration(self.detector, readers.decoders, readers.types))
        self.engine.set_rules(compiled(self.detector, rule))

    def publish(self, key: str, payload: bytes, encoding: str) -> None:
        self.published.append(json.loads(payload))

    def query(self, *_: Any) -> list[bytes]:
        raise AssertionError("the database action sends no queries")

    def take(self, samples: list[Any], until: float) -> None:
        self.engine.advance(samples, at(until))
        self.host.dispatch(self.engine.consequences.drain(self.engine.now))


def odometry(seconds: float, number: int, v: float) -> Any:
    return arrival(seconds, "car1", {"n": number, "twist": {"twist": {"linear": {"x": v}}}}, "odometry")


def numbers(database: Any) -> list[float]:
    return [each["msg"]["n"] for each in database["json/odometry"].find(sort=[("_id", 1)])]


def test_record_all_has_every_sample_once_from_one_evaluation_to_the_next(
    name: str, database: Any, proxy: ServerProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    drive = Drive(as_json(RECORD_ALL, name), proxy, monkeypatch)
    for second in range(5):
        drive.take([odometry(second + k / 100, 100 * second + k, 5) for k in range(100)], second + 1)
    drive.take([arrival(5.5, "car1", b"x" * 1000, "points")], 6)
    drive.take([], 40)  # the client is lost
    wait_until(lambda: [each["complete"] for each in database["Scenarios"].find()] == [True])
    drive.host.close()
    assert numbers(database) == list(range(500))
    assert database["raw/points"].find_one()["msg"] == b"x" * 1000
    (scenario,) = database["Scenarios"].find()
    assert scenario["messages"] == {"json/odometry": 500, "raw/points": 1}
    assert scenario["reason"] == "ClientLost"


def test_threshold_records_the_window_around_the_crossing(
    name: str, database: Any, proxy: ServerProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    drive = Drive(as_json(THRESHOLD, name), proxy, monkeypatch)
    speeds = [20.0] * 1000 + [20 - 0.1 * k for k in range(1, 101)] + [10.0] * 500
    drive.take([odometry(k / 100, k, v) for k, v in enumerate(speeds)], 16)
    wait_until(lambda: [each["complete"] for each in database["Scenarios"].find()] == [True])
    drive.host.close()
    assert [each["type"].rpartition(".")[2] for each in drive.published] == ["running", "done"]
    (scenario,) = database["Scenarios"].find()
    onset, end = scenario["onsetTime"], scenario["endTime"]
    assert numbers(database) == [k for k in range(1600) if onset - 5 * 10**9 < at(k / 100) <= end + 2 * 10**9]
    assert scenario["metadata"]["campaign"] == "autumn"
    assert re.fullmatch(r"-\d+(\.\d+)? m/s", scenario["metadata"]["lost"])
