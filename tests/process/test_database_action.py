"""The database action writes each sample of an episode once, and calls complete only what is."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from detector.actions import ActionError, EpisodeSample, OutcomeState
from detector.actions.database.server import Redactor
from tests.driving import START, a_stream
from tests.mongodb.way import Way
from tests.process.database_desk import Desk, speeds, spooled, wait_until

SPEEDS = "json/speed"


MakeDesk = Callable[..., Desk]


@pytest.fixture
def desk(way: Way, name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[MakeDesk]:
    monkeypatch.setenv("TEST_MONGODB_URI", way.uri)
    made: list[Desk] = []

    def make(
        spool: int | None = None,
        streams: Any = (),
        files: bool = False,
        above: str = "64Ki",
        concern: str = "Majority",
        **parameters: Any,
    ) -> Desk:
        place: dict[str, Any] = {"uriVariable": "TEST_MONGODB_URI", "writeConcern": concern}
        if spool is not None:
            place["spool"] = {"path": str(tmp_path / "spool"), "bytes": str(spool)}
        if files:
            place["files"] = {"path": str(tmp_path / "files")}
            parameters["files"] = {"above": above}
        made.append(Desk(place, name, streams, **parameters))
        return made[-1]

    yield make
    for each in made:
        each.close()


def numbers(database: Any, scenario: str = "e1.keep", collection: str = SPEEDS) -> list[float]:
    return [each["msg"]["v"] for each in database[collection].find({"scenario": scenario}, sort=[("_id", 1)])]


def scenario(database: Any, name: str = "e1.keep") -> dict[str, Any]:
    found = database["Scenarios"].find_one({"_id": name})
    assert found is not None
    return dict(found)


def test_an_episode_becomes_a_scenario_with_each_sample_once(desk: MakeDesk, database: Any) -> None:
    keep = desk()
    episode = keep.begin(rendered={"metadata": {"driver": "Ada"}})
    keep.take(episode, speeds(2500))
    keep.finish(episode)
    outcome = keep.outcome()
    assert outcome.state is OutcomeState.DONE, outcome
    assert outcome.samples == 2500
    assert numbers(database) == [float(each) for each in range(2500)]
    told = scenario(database)
    assert told["complete"] is True
    assert told["state"] == "Complete"
    assert told["rule"] == "brake"
    assert told["metadata"] == {"driver": "Ada"}
    assert told["classification"] == {"incidence": ["Rare"]}
    assert told["values"] == {"speed": 12.5}
    assert told["messages"] == {SPEEDS: 2500}
    assert told["onsetTime"] == START
    kind = database["ScenarioTypes"].find_one({"_id": told["type"]})
    assert (kind["rule"], kind["description"]) == ("brake", "Hard braking.")
    assert json.loads(kind["spec"])["when"] == "true"
    client = database["ConnectedClients"].find_one({"_id": "car1"})
    assert (client["firstSeen"], client["lastSeen"]) == (START, START + 2499 * 10_000_000)
    assert client["streams"] == ["speed"]


def test_with_renew_after_an_episode_becomes_one_scenario_after_the_other(desk: MakeDesk, database: Any) -> None:
    keep = desk(streams=[a_stream("speed"), a_stream("map", latched=True)], renew_after="3s")
    episode = keep.begin()
    said = EpisodeSample("car1", "map", "vehicles/car1/map", START - 10**12, START - 10**12, b'{"v": -1}')
    later = said._replace(time=START + 7 * 10**9, received=START + 7 * 10**9, payload=b'{"v": -2}')
    samples = speeds(1000)
    for first in range(0, 1000, 130):
        keep.take(episode, [*([] if first else [said]), *samples[first : first + 130]])
        if first == 650:
            keep.take(episode, [later])
    keep.finish(episode)
    outcome = keep.outcome()
    assert outcome.state is OutcomeState.DONE, outcome
    assert outcome.samples == 1000 + 5  # what was said on latched streams is in each
    parts = {each["_id"]: each for each in database["Scenarios"].find()}
    assert [each["complete"] for each in parts.values()] == [True] * 4
    assert sorted(numbers(database, part) for part in parts) == [
        list(range(300)),
        list(range(300, 600)),
        list(range(600, 900)),
        list(range(900, 1000)),
    ]
    assert sorted(numbers(database, part, "json/map") for part in parts) == [[-2], [-1], [-1], [-1, -2]]


def test_after_a_restart_a_renewed_episode_leaves_alone_what_was_complete(desk: MakeDesk, database: Any) -> None:
    keep = desk(renew_after="3s")
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


def test_overlapping_episodes_have_their_samples_each(desk: MakeDesk, database: Any) -> None:
    keep = desk()
    one, two = keep.begin("e1"), keep.begin("e2")
    samples = speeds(30)
    keep.take(one, samples[:20])
    keep.take(two, samples[10:])
    keep.finish(one)
    keep.finish(two)
    assert [keep.outcome(name).state for name in ("e1", "e2")] == [OutcomeState.DONE] * 2
    assert numbers(database, "e1.keep") == list(range(20))
    assert numbers(database, "e2.keep") == list(range(10, 30))


def test_a_scenario_is_not_complete_while_it_lasts_nor_where_something_is_missing(
    desk: MakeDesk, database: Any
) -> None:
    keep = desk()
    lasting, cut = keep.begin("e1"), keep.begin("e2")
    keep.take(lasting, speeds(5))
    keep.finish(cut, cut="the detector ends", missing=3)
    outcome = keep.outcome("e2")
    assert outcome.state is OutcomeState.FAILED
    assert outcome.missing == 3
    assert "the detector ends" in outcome.message
    assert (scenario(database)["state"], scenario(database)["complete"]) == ("Open", False)
    told = scenario(database, "e2.keep")
    assert (told["state"], told["complete"], told["missing"], told["cut"]) == (
        "Incomplete",
        False,
        3,
        "the detector ends",
    )


def test_an_episode_whose_beginning_another_run_saw_is_never_complete(desk: MakeDesk, database: Any) -> None:
    keep = desk()
    episode = keep.begin(resumed=True)
    keep.take(episode, speeds(5))
    keep.finish(episode)
    assert keep.outcome().state is OutcomeState.FAILED
    assert (scenario(database)["state"], scenario(database)["complete"]) == ("Interrupted", False)


def test_with_dry_run_everything_is_counted_and_nothing_is_written(
    desk: MakeDesk, database: Any, tmp_path: Path
) -> None:
    keep = desk(streams=[a_stream("blob", encoding="raw")], files=True, dry_run=True)
    episode = keep.begin()
    keep.take(episode, [EpisodeSample("car1", "blob", "vehicles/car1/blob", START, START, bytes(100_000))])
    keep.finish(episode)
    outcome = keep.outcome()
    assert (outcome.state, outcome.samples) == (OutcomeState.DONE, 1)
    assert outcome.details["complete"] is False
    assert database.list_collection_names() == []
    assert not (tmp_path / "files").exists()


def test_large_binary_data_goes_to_files_that_the_documents_name(desk: MakeDesk, database: Any, tmp_path: Path) -> None:
    keep = desk(streams=[a_stream("blob", encoding="raw")], files=True, above="1k")
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


def test_without_files_what_mongodb_does_not_take_is_cut_counted_and_said(desk: MakeDesk, database: Any) -> None:
    keep = desk(streams=[a_stream("blob", encoding="raw")])
    episode = keep.begin()
    keep.take(episode, [EpisodeSample("car1", "blob", "vehicles/car1/blob", START, START, bytes(17 * 2**20))])
    keep.finish(episode)
    outcome = keep.outcome()
    assert (outcome.state, outcome.missing) == (OutcomeState.FAILED, 1)
    assert "too large" in outcome.message
    assert "cut" in database["raw/blob"].find_one()
    assert scenario(database)["complete"] is False
    assert keep.losses.total() == 1


def test_a_file_that_cannot_be_written_costs_the_scenarios_completeness(
    desk: MakeDesk, database: Any, tmp_path: Path
) -> None:
    (tmp_path / "files").write_text("no folder")
    keep = desk(streams=[a_stream("blob", encoding="raw")], files=True)
    episode = keep.begin()
    keep.take(episode, [EpisodeSample("car1", "blob", "vehicles/car1/blob", START, START, bytes(100_000))])
    keep.finish(episode)
    outcome = keep.outcome()
    assert (outcome.state, outcome.missing) == (OutcomeState.FAILED, 1)
    assert database["raw/blob"].find_one()["filesMissing"][0]["error"].startswith("a file could not be written")
    assert scenario(database)["complete"] is False


def test_while_the_server_is_away_documents_wait_on_disk_and_follow_in_order_each_once(
    desk: MakeDesk, database: Any, way: Way, tmp_path: Path
) -> None:
    keep = desk(spool=2**26)
    first, second = keep.begin("e1"), keep.begin("e2")
    keep.take(first, speeds(1500))
    wait_until(lambda: len(numbers(database)) >= 1000)
    way.cut()
    keep.take(first, speeds(3000, first=1500))
    keep.finish(first)
    keep.take(second, speeds(100))
    keep.finish(second)
    wait_until(lambda: spooled(tmp_path / "spool") > 100_000)
    assert scenario(database)["complete"] is False
    way.restore()
    assert [keep.outcome(name).state for name in ("e1", "e2")] == [OutcomeState.DONE] * 2
    assert numbers(database) == list(range(4500))
    assert numbers(database, "e2.keep") == list(range(100))
    assert not keep.losses
    wait_until(lambda: not list((tmp_path / "spool").glob("*.spool")))


def test_a_full_spool_drops_what_is_new_counts_it_and_keeps_earlier_scenarios_whole(
    desk: MakeDesk, database: Any, way: Way, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("detector.actions.database.queue.MEMORY", 100_000)
    keep = desk(spool=400_000)
    way.cut()
    early, late = keep.begin("e1"), keep.begin("e2")
    keep.take(early, speeds(500))
    keep.finish(early)
    for number in range(10):
        keep.take(late, speeds(1000, first=1000 * number))
    keep.finish(late)
    assert keep.losses.total() > 0
    way.restore()
    assert keep.outcome("e1").state is OutcomeState.DONE
    outcome = keep.outcome("e2")
    assert outcome.state is OutcomeState.FAILED
    assert outcome.missing == keep.losses.total()
    there = numbers(database, "e2.keep")
    assert len(there) + keep.losses.total() == 10_000
    assert len(set(there)) == len(there)
    assert numbers(database) == list(range(500))
    told = scenario(database, "e2.keep")
    assert (told["complete"], told["missing"]) == (False, outcome.missing)


def test_what_waited_when_the_detector_ended_is_written_by_the_next_run(
    desk: MakeDesk, database: Any, way: Way
) -> None:
    way.cut()
    before = desk(spool=2**26)
    episode, open_one = before.begin("e1"), before.begin("e2")
    before.take(episode, speeds(1200))
    before.take(open_one, speeds(10))
    before.finish(episode)
    before.close()
    assert "waits in the spool" in before.outcome("e1").message
    way.restore()
    after = desk(spool=2**26)
    wait_until(lambda: scenario_or_none(database, "e2.keep").get("state") == "Interrupted")
    assert numbers(database) == list(range(1200))
    assert scenario(database)["complete"] is True
    assert scenario(database, "e2.keep")["complete"] is False
    assert not after.losses


def scenario_or_none(database: Any, name: str) -> dict[str, Any]:
    return database["Scenarios"].find_one({"_id": name}) or {}


def test_a_document_that_the_server_refuses_costs_its_scenarios_completeness_and_no_other(
    desk: MakeDesk, database: Any, way: Way
) -> None:
    keep = desk()
    good, bad = keep.begin("e1"), keep.begin("e2")
    samples = speeds(40)
    way.poison = b"a poisoned text"
    poisoned = samples[20]._replace(payload=b'{"v": 20, "text": "a poisoned text"}')
    keep.take(good, samples)
    keep.take(bad, [*samples[:20], poisoned, *samples[21:]])
    keep.finish(bad)
    keep.finish(good)
    assert keep.outcome("e1").state is OutcomeState.DONE
    outcome = keep.outcome("e2")
    assert outcome.state is OutcomeState.FAILED
    assert numbers(database) == list(range(40))
    assert numbers(database, "e2.keep") == [each for each in range(40) if each != 20]
    assert keep.losses.total() == 1
    told = scenario(database, "e2.keep")
    assert (told["complete"], told["rejected"]) == (False, True)


def test_a_server_that_hangs_holds_up_nothing_but_the_queue(
    desk: MakeDesk, database: Any, way: Way, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("detector.actions.database.server._SECONDS", 4.0)
    keep = desk(spool=2**26)
    episode = keep.begin()
    way.hang()
    keep.take(episode, speeds(2000))
    keep.finish(episode)
    wait_until(lambda: (keep.action._store is not None) and keep.action._store.away != "")
    way.restore()
    assert keep.outcome().state is OutcomeState.DONE
    assert numbers(database) == list(range(2000))


def test_with_write_concern_one_a_scenario_that_lost_documents_afterwards_is_not_called_complete(
    desk: MakeDesk, database: Any
) -> None:
    keep = desk(concern="One")
    episode = keep.begin()
    keep.take(episode, speeds(1000))
    wait_until(lambda: len(numbers(database)) == 1000)
    database[SPEEDS].delete_one({"msg.v": 7})
    keep.finish(episode)
    outcome = keep.outcome()
    assert outcome.state is OutcomeState.FAILED
    assert "only 999 of 1000 documents in json/speed" in outcome.message
    assert scenario(database)["complete"] is False


def test_what_somebody_removed_from_the_spool_costs_its_scenario_and_no_other(
    desk: MakeDesk, database: Any, way: Way, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("detector.actions.database.spool.SEGMENT", 1000)
    keep = desk(spool=2**26)
    way.cut()
    first, second = keep.begin("e1"), keep.begin("e2")
    keep.take(first, speeds(2000))

    def of_a_thousand() -> list[Path]:
        return sorted(each for each in (tmp_path / "spool").glob("*.spool") if each.stat().st_size > 100_000)

    wait_until(lambda: len(of_a_thousand()) == 2)
    doomed = of_a_thousand()[0]  # the first thousand of the first episode, while nothing else is there
    keep.take(second, speeds(1000))
    keep.finish(second)
    keep.finish(first)
    doomed.unlink()
    way.restore()
    assert keep.outcome("e2").state is OutcomeState.DONE
    assert keep.outcome("e1").state is OutcomeState.FAILED
    assert scenario(database)["complete"] is False
    assert keep.losses.total() > 0


def test_open_episodes_say_that_the_database_is_away(desk: MakeDesk, way: Way) -> None:
    keep = desk(spool=2**26)
    episode = keep.begin()
    way.cut()

    def told(away: bool) -> bool:
        keep.take(episode, speeds(1000))
        last = keep.last()
        return last is not None and last.message.startswith("the database is away") is away

    wait_until(lambda: told(True))
    way.restore()
    wait_until(lambda: told(False))


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
    keep = Desk({"uriVariable": "TEST_MONGODB_URI"}, name)
    said = ""
    try:
        episode = keep.begin()
        keep.take(episode, speeds(3))
        keep.finish(episode)
        wait_until(lambda: keep.action._store is not None and keep.action._store.away != "")
    except ActionError as error:
        said = f"{error!r} {error.__cause__!r} {error.__context__!r} {error}"
        assert "spec.database" in said
    keep.close()
    said += "".join(map(str, keep.outcomes.values())) + caplog.text + str(keep.losses)
    assert said
    for piece in (SECRET, "s3cr3t", "p@ss", "ss%20word"):
        assert piece not in said


def test_the_redactor_takes_out_every_form_of_the_password() -> None:
    clean = Redactor("mongodb://ada:a%40b@host/?authMechanismProperties=AWS_SESSION_TOKEN:tok-en")
    assert clean("failed for ada:a%40b, that is a@b, at host with AWS_SESSION_TOKEN:tok-en") == (
        "failed for ***, that is ***, at host with ***"
    )


def test_two_detectors_cannot_share_a_spool(desk: MakeDesk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    desk(spool=2**20)
    monkeypatch.setenv("OTHER_URI", "mongodb://127.0.0.1:1/")
    place = {"uriVariable": "OTHER_URI", "spool": {"path": str(tmp_path / "spool"), "bytes": "1Mi"}}
    other = Desk(place, "other")
    with pytest.raises(ActionError, match=r"spec.database.spool.path: .* is used by another process"):
        other.begin()
