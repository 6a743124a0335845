"""The database action with an unreachable, hanging or rejecting server counts each loss and writes nothing twice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from detector.actions import OutcomeState
from tests.mongodb.proxy import ServerProxy
from tests.process.database_harness import (
    SPEEDS,
    MakeHarness,
    numbers,
    scenario,
    scenario_or_none,
    speeds,
    spooled,
    wait_until,
)


def test_documents_are_spooled_to_disk_during_an_outage_and_written_once_in_order(
    harness: MakeHarness, database: Any, proxy: ServerProxy, tmp_path: Path
) -> None:
    keep = harness(spool=2**26)
    first, second = keep.begin("e1"), keep.begin("e2")
    keep.take(first, speeds(1500))
    wait_until(lambda: len(numbers(database)) >= 1000)
    proxy.cut()
    keep.take(first, speeds(3000, first=1500))
    keep.finish(first)
    keep.take(second, speeds(100))
    keep.finish(second)
    wait_until(lambda: spooled(tmp_path / "spool") > 100_000)
    assert scenario(database)["complete"] is False
    proxy.restore()
    assert [keep.outcome(name).state for name in ("e1", "e2")] == [OutcomeState.DONE] * 2
    assert numbers(database) == list(range(4500))
    assert numbers(database, "e2.keep") == list(range(100))
    assert not keep.losses
    keep.close()
    assert not list((tmp_path / "spool").iterdir())


def test_a_full_spool_drops_and_counts_new_documents_and_keeps_earlier_scenarios_complete(
    harness: MakeHarness, database: Any, proxy: ServerProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("detector.actions.database.queue.MEMORY", 100_000)
    keep = harness(spool=400_000)
    proxy.cut()
    early, late = keep.begin("e1"), keep.begin("e2")
    keep.take(early, speeds(500))
    keep.finish(early)
    for number in range(10):
        keep.take(late, speeds(1000, first=1000 * number))
    keep.finish(late)
    assert keep.losses.total() > 0
    proxy.restore()
    assert keep.outcome("e1").state is OutcomeState.DONE
    outcome = keep.outcome("e2")
    assert outcome.state is OutcomeState.FAILED
    assert outcome.missing == keep.losses.total()
    there = numbers(database, "e2.keep")
    assert len(there) + keep.losses.total() == 10_000
    assert len(set(there)) == len(there)
    assert numbers(database) == list(range(500))
    reported = scenario(database, "e2.keep")
    assert (reported["complete"], reported["missing"]) == (False, outcome.missing)


def test_documents_spooled_at_shutdown_are_written_by_the_next_run(
    harness: MakeHarness, database: Any, proxy: ServerProxy
) -> None:
    proxy.cut()
    before = harness(spool=2**26)
    episode, open_one = before.begin("e1"), before.begin("e2")
    before.take(episode, speeds(1200))
    before.take(open_one, speeds(10))
    before.finish(episode)
    before.close()
    assert "stay in the spool" in before.outcome("e1").message
    proxy.restore()
    after = harness(spool=2**26)
    wait_until(lambda: scenario_or_none(database, "e2.keep").get("state") == "Interrupted")
    assert numbers(database) == list(range(1200))
    assert scenario(database)["complete"] is True
    assert scenario(database, "e2.keep")["complete"] is False
    assert not after.losses


def test_a_document_rejected_by_the_server_makes_only_its_scenario_incomplete(
    harness: MakeHarness, database: Any, proxy: ServerProxy
) -> None:
    keep = harness()
    good, bad = keep.begin("e1"), keep.begin("e2")
    samples = speeds(40)
    proxy.poison = b"a poisoned text"
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
    reported = scenario(database, "e2.keep")
    assert (reported["complete"], reported["rejected"]) == (False, True)


def test_a_hanging_server_delays_only_the_queue(
    harness: MakeHarness, database: Any, proxy: ServerProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("detector.actions.database.server._SECONDS", 4.0)
    keep = harness(spool=2**26)
    episode = keep.begin()
    proxy.hang()
    keep.take(episode, speeds(2000))
    keep.finish(episode)
    wait_until(lambda: (keep.action._writer is not None) and keep.action._writer.away != "")
    proxy.restore()
    assert keep.outcome().state is OutcomeState.DONE
    assert numbers(database) == list(range(2000))


def test_with_write_concern_one_a_scenario_that_lost_documents_is_not_marked_complete(
    harness: MakeHarness, database: Any
) -> None:
    keep = harness(concern="One")
    episode = keep.begin()
    keep.take(episode, speeds(1000))
    wait_until(lambda: len(numbers(database)) == 1000)
    database[SPEEDS].delete_one({"msg.v": 7})
    keep.finish(episode)
    outcome = keep.outcome()
    assert outcome.state is OutcomeState.FAILED
    assert "only 999 of 1000 documents in json/speed" in outcome.message
    assert scenario(database)["complete"] is False


def test_a_damaged_spool_entry_makes_only_its_scenario_incomplete(
    harness: MakeHarness, database: Any, proxy: ServerProxy
) -> None:
    keep = harness(spool=2**26)
    proxy.cut()
    first, second = keep.begin("e1"), keep.begin("e2")
    keep.take(first, speeds(2000))
    assert keep.action._writer is not None
    queue = keep.action._writer._queue
    large = "SELECT id FROM records WHERE length(record) > 100000 ORDER BY id"

    def of_a_thousand() -> list[tuple[int]]:
        with queue._disk:
            assert queue._spool is not None
            return queue._spool._db.execute(large).fetchall()

    wait_until(lambda: len(of_a_thousand()) == 2)
    doomed = of_a_thousand()[0]  # the first thousand of the first episode, while nothing else is there
    keep.take(second, speeds(1000))
    keep.finish(second)
    keep.finish(first)
    with queue._disk:
        assert queue._spool is not None
        queue._spool._db.execute("UPDATE records SET record = zeroblob(length(record)) WHERE id = ?", doomed)
    proxy.restore()
    assert keep.outcome("e2").state is OutcomeState.DONE
    assert keep.outcome("e1").state is OutcomeState.FAILED
    assert scenario(database)["complete"] is False
    assert keep.losses.total() == 1


def test_a_spool_on_a_failing_disk_delays_nothing_and_continues_after_a_restart(
    harness: MakeHarness, database: Any, proxy: ServerProxy, tmp_path: Path
) -> None:
    keep = harness(spool=2**26)
    proxy.cut()
    first = keep.begin("e1")
    keep.take(first, speeds(2000))
    wait_until(lambda: spooled(tmp_path / "spool") > 100_000)
    assert keep.action._writer is not None
    queue = keep.action._writer._queue
    with queue._disk:
        assert queue._spool is not None
        queue._spool._db.close()  # like a removed disk: each further request fails
    second = keep.begin("e2")
    keep.take(second, speeds(1000))
    keep.finish(second)
    keep.finish(first)
    proxy.restore()
    assert keep.outcome("e2").state is OutcomeState.DONE
    assert keep.outcome("e1").state is OutcomeState.FAILED
    assert keep.losses.total() > 0
    keep.close()
    after = harness(spool=2**26)
    wait_until(lambda: len(numbers(database)) == 2000)
    assert not scenario(database).get("complete")
    assert not after.losses


def test_open_episodes_report_that_the_database_is_away(harness: MakeHarness, proxy: ServerProxy) -> None:
    keep = harness(spool=2**26)
    episode = keep.begin()
    proxy.cut()

    def reported(away: bool) -> bool:
        keep.take(episode, speeds(1000))
        last = keep.last()
        return last is not None and last.message.startswith("the database is unavailable") is away

    wait_until(lambda: reported(True))
    proxy.restore()
    wait_until(lambda: reported(False))
