"""The database action writes each sample of an episode once, and marks only complete scenarios as complete."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import pytest

from detector.actions import ActionError, EpisodeSample, OutcomeState
from detector.actions.database.server import Redactor
from tests.driving import START, a_stream
from tests.process.database_harness import (
    SPEEDS,
    Harness,
    MakeHarness,
    numbers,
    scenario,
    scenario_or_none,
    speeds,
    wait_until,
)


def test_an_episode_becomes_a_scenario_with_each_sample_once(harness: MakeHarness, database: Any) -> None:
    keep = harness()
    episode = keep.begin(rendered={"metadata": {"driver": "Ada"}})
    keep.take(episode, speeds(2500))
    keep.finish(episode)
    outcome = keep.outcome()
    assert outcome.state is OutcomeState.DONE, outcome
    assert outcome.samples == 2500
    assert numbers(database) == [float(each) for each in range(2500)]
    reported = scenario(database)
    assert reported["complete"] is True
    assert reported["state"] == "Complete"
    assert reported["rule"] == "brake"
    assert reported["metadata"] == {"driver": "Ada"}
    assert reported["classification"] == {"incidence": ["Rare"]}
    assert reported["values"] == {"speed": 12.5}
    assert reported["messages"] == {SPEEDS: 2500}
    assert reported["onsetTime"] == START
    kind = database["ScenarioTypes"].find_one({"_id": reported["type"]})
    assert (kind["rule"], kind["description"]) == ("brake", "Hard braking.")
    assert json.loads(kind["spec"])["when"] == "true"
    client = database["ConnectedClients"].find_one({"_id": "car1"})
    assert (client["firstSeen"], client["lastSeen"]) == (START, START + 2499 * 10_000_000)
    assert client["streams"] == ["speed"]


def test_with_renew_after_an_episode_becomes_consecutive_scenarios(harness: MakeHarness, database: Any) -> None:
    keep = harness(streams=[a_stream("speed"), a_stream("map", latched=True)], renew_after="3s")
    episode = keep.begin()
    logged = EpisodeSample("car1", "map", "vehicles/car1/map", START - 10**12, START - 10**12, b'{"v": -1}')
    later = logged._replace(time=START + 7 * 10**9, received=START + 7 * 10**9, payload=b'{"v": -2}')
    samples = speeds(1000)
    for first in range(0, 1000, 130):
        keep.take(episode, [*([] if first else [logged]), *samples[first : first + 130]])
        if first == 650:
            keep.take(episode, [later])
    keep.finish(episode)
    outcome = keep.outcome()
    assert outcome.state is OutcomeState.DONE, outcome
    assert outcome.samples == 1000 + 5  # the latched samples are in each
    parts = {each["_id"]: each for each in database["Scenarios"].find()}
    assert [each["complete"] for each in parts.values()] == [True] * 4
    assert sorted(numbers(database, part) for part in parts) == [
        list(range(300)),
        list(range(300, 600)),
        list(range(600, 900)),
        list(range(900, 1000)),
    ]
    assert sorted(numbers(database, part, "json/map") for part in parts) == [[-2], [-1], [-1], [-1, -2]]


def test_after_a_restart_a_renewed_episode_keeps_complete_scenarios(harness: MakeHarness, database: Any) -> None:
    keep = harness(renew_after="3s")
    episode = keep.begin()
    keep.take(episode, speeds(500))
    wait_until(lambda: scenario_or_none(database, "e1.keep").get("complete") is True)
    resumed = keep.begin(resumed=True)
    keep.take(resumed, speeds(500, first=600))
    keep.finish(resumed)
    assert keep.outcome().state is OutcomeState.FAILED
    assert (scenario(database)["complete"], scenario(database)["state"]) == (True, "Complete")
    states = sorted(each["state"] for each in database["Scenarios"].find())
    assert states == ["Complete", "Complete", "Interrupted", "Open"]


def test_overlapping_episodes_each_have_their_samples(harness: MakeHarness, database: Any) -> None:
    keep = harness()
    one, two = keep.begin("e1"), keep.begin("e2")
    samples = speeds(30)
    keep.take(one, samples[:20])
    keep.take(two, samples[10:])
    keep.finish(one)
    keep.finish(two)
    assert [keep.outcome(name).state for name in ("e1", "e2")] == [OutcomeState.DONE] * 2
    assert numbers(database, "e1.keep") == list(range(20))
    assert numbers(database, "e2.keep") == list(range(10, 30))


def test_a_scenario_is_incomplete_while_open_or_if_data_is_missing(harness: MakeHarness, database: Any) -> None:
    keep = harness()
    lasting, cut = keep.begin("e1"), keep.begin("e2")
    keep.take(lasting, speeds(5))
    keep.finish(cut, cut="the detector ends", missing=3)
    outcome = keep.outcome("e2")
    assert outcome.state is OutcomeState.FAILED
    assert outcome.missing == 3
    assert "the detector ends" in outcome.message
    assert (scenario(database)["state"], scenario(database)["complete"]) == ("Open", False)
    reported = scenario(database, "e2.keep")
    assert (reported["state"], reported["complete"], reported["missing"], reported["cut"]) == (
        "Incomplete",
        False,
        3,
        "the detector ends",
    )


def test_an_episode_that_started_in_an_earlier_run_is_never_complete(harness: MakeHarness, database: Any) -> None:
    keep = harness()
    episode = keep.begin(resumed=True)
    keep.take(episode, speeds(5))
    keep.finish(episode)
    assert keep.outcome().state is OutcomeState.FAILED
    assert (scenario(database)["state"], scenario(database)["complete"]) == ("Interrupted", False)


def test_with_dry_run_everything_is_counted_and_nothing_is_written(
    harness: MakeHarness, database: Any, tmp_path: Path
) -> None:
    keep = harness(streams=[a_stream("blob", encoding="raw")], files=True, dry_run=True)
    episode = keep.begin()
    keep.take(episode, [EpisodeSample("car1", "blob", "vehicles/car1/blob", START, START, bytes(100_000))])
    keep.finish(episode)
    outcome = keep.outcome()
    assert (outcome.state, outcome.samples) == (OutcomeState.DONE, 1)
    assert outcome.details["complete"] is False
    assert database.list_collection_names() == []
    assert not (tmp_path / "files").exists()


def test_large_binary_data_is_stored_in_files_named_in_the_documents(
    harness: MakeHarness, database: Any, tmp_path: Path
) -> None:
    keep = harness(streams=[a_stream("blob", encoding="raw")], files=True, above="1k")
    episode = keep.begin()
    blobs = [bytes([number]) * size for number, size in ((1, 999), (2, 5000), (3, 20_000_000))]
    keep.take(
        episode,
        [EpisodeSample("car1", "blob", "vehicles/car1/blob", START + i, START + i, b) for i, b in enumerate(blobs)],
    )
    keep.finish(episode)
    assert keep.outcome().state is OutcomeState.DONE
    small, *large = database["raw/blob"].find(sort=[("_id", 1)])
    assert small["msg"] == blobs[0]
    for document, blob in zip(large, blobs[1:], strict=True):
        assert (tmp_path / "files" / document["msg"]["file"]).read_bytes() == blob
        assert document["msg"]["bytes"] == len(blob)
    assert scenario(database)["files"] == 2


def test_without_files_documents_too_large_for_mongodb_are_truncated_counted_and_reported(
    harness: MakeHarness, database: Any
) -> None:
    keep = harness(streams=[a_stream("blob", encoding="raw")])
    episode = keep.begin()
    keep.take(episode, [EpisodeSample("car1", "blob", "vehicles/car1/blob", START, START, bytes(17 * 2**20))])
    keep.finish(episode)
    outcome = keep.outcome()
    assert (outcome.state, outcome.missing) == (OutcomeState.FAILED, 1)
    assert "too large" in outcome.message
    assert "cut" in database["raw/blob"].find_one()
    assert scenario(database)["complete"] is False
    assert keep.losses.total() == 1


def test_a_file_write_error_makes_its_scenario_incomplete(harness: MakeHarness, database: Any, tmp_path: Path) -> None:
    (tmp_path / "files").write_text("no folder")
    keep = harness(streams=[a_stream("blob", encoding="raw")], files=True)
    episode = keep.begin()
    keep.take(episode, [EpisodeSample("car1", "blob", "vehicles/car1/blob", START, START, bytes(100_000))])
    keep.finish(episode)
    outcome = keep.outcome()
    assert (outcome.state, outcome.missing) == (OutcomeState.FAILED, 1)
    assert database["raw/blob"].find_one()["filesMissing"][0]["error"].startswith("cannot write a file")
    assert scenario(database)["complete"] is False


SECRET = "s3cr3t/p@ss word"


@pytest.mark.parametrize(
    "uri",
    [
        f"mongodb://ada:{SECRET}@127.0.0.1:1/",
        "mongodb://ada:s3cr3t%2Fp%40ss%20word@127.0.0.1:1/?authMechanism=SCRAM-SHA-256",
        f"mongodb+srv://ada:{SECRET}@nowhere:99999/",
        f"mongodb://ada:{SECRET}@[::1/",
        "mongodb://ada:s3cr3t%2Fp%40ss%20word@127.0.0.1:1/?authMechanism=s3cr3t%2Fp%40ss%20word",
        f"ada:{SECRET}@127.0.0.1",
    ],
)
def test_credentials_are_in_no_error_log_or_outcome(
    uri: str, name: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    monkeypatch.setenv("TEST_MONGODB_URI", uri)
    keep = Harness({"uriVariable": "TEST_MONGODB_URI"}, name)
    logged = ""
    try:
        episode = keep.begin()
        keep.take(episode, speeds(3))
        keep.finish(episode)
        wait_until(lambda: keep.action._writer is not None and keep.action._writer.away != "")
    except ActionError as error:
        logged = f"{error!r} {error.__cause__!r} {error.__context__!r} {error}"
        assert "spec.database" in logged
    keep.close()
    logged += "".join(map(str, keep.outcomes.values())) + caplog.text + str(keep.losses)
    assert logged
    for piece in (SECRET, "s3cr3t", "p@ss", "ss%20word"):
        assert piece not in logged


def test_the_redactor_removes_every_form_of_the_password() -> None:
    clean = Redactor("mongodb://ada:a%40b@host/?authMechanismProperties=AWS_SESSION_TOKEN:tok-en")
    assert clean("failed for ada:a%40b, that is a@b, at host with AWS_SESSION_TOKEN:tok-en") == (
        "failed for ***, that is ***, at host with ***"
    )


def test_two_detectors_cannot_share_a_spool(
    harness: MakeHarness, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    harness(spool=2**20)
    monkeypatch.setenv("OTHER_URI", "mongodb://127.0.0.1:1/")
    place = {"uriVariable": "OTHER_URI", "spool": {"path": str(tmp_path / "spool"), "bytes": "1Mi"}}
    other = Harness(place, "other")
    with pytest.raises(ActionError, match=r"spec.database.spool.path: another process uses"):
        other.begin()
