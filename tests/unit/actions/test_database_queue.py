"""The queue of requests to the database, with a spool that is damaged."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from detector.actions.database.queue import Queue, Write
from wayside.api.database import DatabaseSpool


def a_queue(folder: Path, losses: Counter[str]) -> Queue:
    def lose(what: str, count: int, why: str) -> None:
        losses[what] += count

    return Queue(DatabaseSpool(path=str(folder)), lose)


def add(queue: Queue, *documents: bytes) -> None:
    with queue.changed:
        for document in documents:
            queue.add(Write("d", "c", [document]))


def test_a_spool_that_cannot_be_read_is_counted_and_replaced(tmp_path: Path) -> None:
    losses: Counter[str] = Counter()
    (tmp_path / "spool.db").write_bytes(b"no spool" * 1000)
    queue = a_queue(tmp_path, losses)
    assert queue.damaged
    assert losses == {"requests in the database's spool": 1}
    add(queue, b"1")
    assert queue.close() == []
    assert a_queue(tmp_path, losses).first() == Write("d", "c", [b"1"], [])


def test_an_invalid_spool_record_is_counted_and_affects_no_other(tmp_path: Path) -> None:
    losses: Counter[str] = Counter()
    queue = a_queue(tmp_path, losses)
    add(queue, b"0", b"1")
    queue.spill()
    assert queue._spool is not None
    queue._spool.put(queue._spool.keys("")[0], b"something else")
    assert queue.first() == Write("d", "c", [b"1"], [])
    assert losses == {"requests in the database's spool": 1}
    queue.done()
    assert queue.first() is None


def test_a_request_spooled_while_being_sent_is_removed_from_the_spool(tmp_path: Path) -> None:
    queue = a_queue(tmp_path, Counter())
    add(queue, b"0", b"1")
    assert queue.first() == Write("d", "c", [b"0"])
    queue.spill()
    add(queue, b"2")
    queue.done()
    assert queue.first() == Write("d", "c", [b"1"], [])
