"""The store keeps records in their order, within its bounds, beyond crashes; unreadable records are reported."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.actions.store import DurableStore, StoreError, StoreInUseError, action_store


class Losses(list[tuple[int, str]]):
    """Counts and reasons of a store's losses."""

    def __call__(self, count: int, why: str) -> None:
        self.append((count, why))


@pytest.fixture
def losses() -> Losses:
    return Losses()


def contents(store: DurableStore) -> dict[str, bytes | None]:
    return {key: store.get(key) for key in store.keys("")}


def files(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.iterdir())


KEYS = st.sampled_from("abcdef")
STEPS = st.lists(
    st.tuples(st.just("put"), KEYS, st.binary(max_size=9000))
    | st.tuples(st.just("drop"), KEYS, st.just(b""))
    | st.tuples(st.sampled_from(["done", "reopen", "kill"]), st.just(""), st.just(b"")),
    max_size=40,
)


@settings(max_examples=30)
@given(STEPS)
def test_the_store_keeps_added_records_in_order_until_they_are_dropped(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, str, bytes]]
) -> None:
    folder, losses = tmp_path_factory.mktemp("store"), Losses()
    store = DurableStore(folder / "s.db", losses)
    wanted: dict[str, bytes] = {}
    for step, key, record in steps:
        if step == "put":
            assert store.put(key, record)
            wanted[key] = record
        elif step == "drop":
            store.drop(key, "unknown")
            wanted.pop(key, None)
        elif step == "done":
            oldest = next(iter(wanted.items()), None)
            assert store.first() == oldest
            if oldest is not None:
                store.drop(oldest[0])
                del wanted[oldest[0]]
        else:
            if step == "reopen":
                store.close()
            else:
                store._db.close()
            store = DurableStore(folder / "s.db", losses)
        assert (store.count, store.bytes) == (len(wanted), sum(map(len, wanted.values())))
        assert list(contents(store).items()) == list(wanted.items())
    store.drop(*wanted)
    store.close()
    assert not files(folder)
    assert not losses


def test_the_store_stays_within_its_bounds(tmp_path: Path, losses: Losses) -> None:
    store = DurableStore(tmp_path / "s.db", losses, 100)
    assert store.put("a", bytes(50))
    assert store.put("b", bytes(50))
    assert not store.put("c", bytes(1))
    assert store.put("b", bytes(40)), "it replaces a larger one"
    assert store.put("c", bytes(10))
    store.drop("a")
    assert store.put("d", bytes(50))
    assert store.keys("") == ["b", "c", "d"]


def test_the_file_does_not_grow_with_dropped_records_and_shrinks_when_empty(tmp_path: Path, losses: Losses) -> None:
    store = DurableStore(tmp_path / "s.db", losses)

    def size() -> int:
        return sum(file.stat().st_size for file in tmp_path.iterdir())

    store.put("kept", b"x")
    for number in range(300):
        store.put(str(number), bytes(20_000))
        store.drop(str(number))
    assert size() < 3_000_000
    for number in range(300):
        store.put(str(number), bytes(20_000))
    assert size() > 6_000_000
    store.drop("kept", *map(str, range(300)))
    store.sync()
    assert size() < 3_000_000


def test_a_record_truncated_by_a_crash_affects_no_other(tmp_path: Path, losses: Losses) -> None:
    store = DurableStore(tmp_path / "s.db", losses)
    for letter in "ab":
        store.put(letter, letter.encode())
    for name, cut in (("s.db", 0), ("s.db-wal", 1)):
        content = (tmp_path / name).read_bytes()
        (tmp_path / name.replace("s", "crashed", 1)).write_bytes(content[: len(content) - cut])
    store = DurableStore(tmp_path / "crashed.db", losses)
    assert contents(store) == {"a": b"a"}
    assert not losses


def corrupted(path: Path, old: bytes, new: bytes) -> None:
    content = path.read_bytes()
    assert content.count(old) == 1
    path.write_bytes(content.replace(old, new))


def test_a_damaged_record_is_reported_and_affects_no_other(tmp_path: Path, losses: Losses) -> None:
    path = tmp_path / "s.db"
    store = DurableStore(path, losses)
    for number in range(4):
        store.put(str(number), b"record %d" % number)
    store._db.close()
    corrupted(path, b"record 0", b"recorf 0")
    corrupted(path, b"record 2", b"recorf 2")
    store = DurableStore(path, losses)
    assert store.first() == ("1", b"record 1")
    assert store.get("2") is None
    assert contents(store) == {"1": b"record 1", "3": b"record 3"}
    assert losses == [(1, f"cannot read a record of {path}: its checksum is wrong")] * 2
    assert (store.count, store.bytes) == (2, 16)
    store.drop("1", "3")
    assert (store.first(), store.count, store.bytes) == (None, 0, 0)
    store.close()
    assert not files(tmp_path)


def test_a_partly_lost_record_is_reported_and_affects_no_other(tmp_path: Path, losses: Losses) -> None:
    path = tmp_path / "s.db"
    store = DurableStore(path, losses)
    for letter in "abc":
        store.put(letter, letter.encode() * 50_000)
    store._db.close()
    content = bytearray(path.read_bytes())
    page = content.index(b"b" * 4092) // 4096 * 4096
    content[page : page + 4096] = bytes(4096)
    path.write_bytes(content)
    store = DurableStore(path, losses)
    assert store.get("b") is None
    assert contents(store) == {"a": b"a" * 50_000, "c": b"c" * 50_000}
    assert [count for count, _ in losses] == [1]
    assert store.put("d", b"d")


@pytest.mark.parametrize("broken", [b"no database" * 1000, None])
def test_a_file_that_cannot_be_read_is_set_aside_and_replaced(
    tmp_path: Path, losses: Losses, broken: bytes | None, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "s.db"
    store = DurableStore(path, losses)
    for number in range(500):
        store.put(str(number), bytes(100))
    store._db.close()
    path.write_bytes(broken or path.read_bytes()[:4096] + bytes(path.stat().st_size - 4096))
    store = DurableStore(path, losses)
    assert store.first() is None
    assert store.put("a", b"new")
    assert contents(store) == {"a": b"new"}
    assert len(losses) == 1
    assert (
        f"renamed it and started a new one: `sqlite3 {path}.unreadable .recover` prints the remaining records"
        in caplog.text
    )


def test_a_full_disk_leaves_the_records_as_they_were(tmp_path: Path, losses: Losses) -> None:
    path = tmp_path / "s.db"
    store = DurableStore(path, losses)
    store.put("a", b"whole")
    store._db.execute("PRAGMA max_page_count = 8")
    with pytest.raises(StoreError, match=f"cannot write {path}: the disk is full: free space"):
        store.put("b", bytes(100_000))
    assert store.put("c", b"fits")
    assert (store.count, store.bytes) == (2, 9)
    store.close()
    assert contents(DurableStore(path, losses)) == {"a": b"whole", "c": b"fits"}


def test_records_that_cannot_be_removed_from_disk_are_hidden_until_the_next_start(
    tmp_path: Path, losses: Losses
) -> None:
    path = tmp_path / "s.db"
    store = DurableStore(path, losses)
    for letter in "abc":
        store.put(letter, letter.encode())
    store._db.execute("PRAGMA query_only = ON")
    with pytest.raises(StoreError, match=f"cannot use {path}: attempt to write a readonly database: check"):
        store.drop("a")
    assert store.first() == ("b", b"b")
    assert (store.get("a"), store.keys(""), store.count) == (None, ["b", "c"], 2)
    store._db.close()
    store = DurableStore(path, losses)
    assert store.keys("") == ["a", "b", "c"]


def test_a_folder_that_cannot_be_used_is_named(tmp_path: Path, losses: Losses) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="Not a directory: check the path"):
        DurableStore(tmp_path / "file" / "s" / "s.db", losses)
    (tmp_path / "s.db").mkdir()
    with pytest.raises(StoreError, match=r"s\.db: unable to open database file: check"):
        DurableStore(tmp_path / "s.db", losses)


def test_a_file_is_locked_and_readable_only_by_its_owner(tmp_path: Path, losses: Losses) -> None:
    store = DurableStore(tmp_path / "s.db", losses)
    with pytest.raises(StoreInUseError, match=r"another process uses .*s\.db: give each detector its own"):
        DurableStore(tmp_path / "s.db", losses)
    with pytest.raises(StoreInUseError):
        DurableStore(tmp_path / "s.db", losses)
    assert {file.stat().st_mode & 0o777 for file in tmp_path.iterdir()} == {0o600}
    store.close()
    DurableStore(tmp_path / "s.db", losses).close()


def test_concurrent_actions_have_separate_files_and_the_next_run_adopts_both(tmp_path: Path, losses: Losses) -> None:
    first, second = action_store(tmp_path, "j", losses), action_store(tmp_path, "j", losses)
    other = action_store(tmp_path, "j.x", losses)
    for store, key in ((first, "a"), (second, "b"), (other, "c")):
        store.put(key, b"")
    assert (first.keys(""), second.keys(""), other.keys("")) == (["a"], ["b"], ["c"])
    for store in (first, second, other):
        store.close()
    third = action_store(tmp_path, "j", losses)
    assert sorted(third.keys("")) == ["a", "b"]
    third.drop("a", "b")
    third.close()
    assert [name.split(".")[:2] for name in files(tmp_path)] == [["j", "x"]]
