"""The spool keeps records in their order, within its bounds, beyond crashes; unreadable records are reported."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.actions.database import spool as module
from detector.actions.database.spool import Spool, SpoolError


def records(spool: Spool) -> list[bytes]:
    """All of them; the spool is empty then."""
    found = []
    while (record := spool.first()) is not None:
        found.append(record)
        spool.done()
    return found


def reopened(spool: Spool, folder: Path, capacity: int = 2**20) -> Spool:
    spool.close()
    return Spool(folder, capacity)


STEPS = st.lists(st.binary(max_size=40) | st.sampled_from(["done", "reopen"]), max_size=60)


@settings(max_examples=60)
@given(STEPS)
def test_it_is_a_queue_whatever_happens(tmp_path_factory: pytest.TempPathFactory, steps: list[bytes | str]) -> None:
    folder = tmp_path_factory.mktemp("spool")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "SEGMENT", 100)
        spool = Spool(folder, 2**20)
        wanted: list[bytes] = []
        done: list[bytes] = []
        for step in steps:
            if isinstance(step, bytes):
                assert spool.append(step)
                wanted.append(step)
            elif step == "done":
                assert spool.first() == (wanted[0] if wanted else None)
                spool.done()
                done += wanted[:1]
                wanted = wanted[1:]
            else:
                spool = reopened(spool, folder)
                again = spool.records - len(wanted)  # records of a segment that was not yet removed come again
                wanted = done[len(done) - again :] + wanted
            assert spool.records == len(wanted)
        assert records(spool) == wanted
        assert spool.bytes == 0
        assert not list(folder.glob("*.spool"))
        spool.close()


def test_it_holds_no_more_than_it_may(tmp_path: Path) -> None:
    spool = Spool(tmp_path, 100)
    assert spool.append(bytes(40))
    assert spool.append(bytes(40))
    assert not spool.append(bytes(1))
    spool.done()
    assert not spool.append(bytes(1)), "a segment goes as a whole"
    spool.done()
    assert spool.append(bytes(1))
    spool.close()


def test_a_record_that_a_crash_cut_off_is_left_out(tmp_path: Path) -> None:
    spool = Spool(tmp_path, 2**20)
    for text in (b"one", b"two"):
        spool.append(text)
    spool.close()
    (segment,) = tmp_path.glob("*.spool")
    os.truncate(segment, segment.stat().st_size - 1)
    spool = Spool(tmp_path, 2**20)
    assert spool.damaged == 10
    assert spool.append(b"three")
    assert records(spool) == [b"one", b"three"]
    spool.close()


def test_a_damaged_segment_loses_what_is_behind_the_damage_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SEGMENT", 30)
    spool = Spool(tmp_path, 2**20)
    for number in range(8):
        spool.append(b"record %d" % number)
    spool.close()
    first = min(tmp_path.glob("*.spool"))
    content = bytearray(first.read_bytes())
    content[-1] ^= 1
    first.write_bytes(content)
    spool = Spool(tmp_path, 2**20)
    assert spool.damaged == 16
    assert records(spool) == [b"record %d" % number for number in range(8) if number != 1]


def test_a_segment_that_somebody_removed_is_given_up_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SEGMENT", 30)
    spool = Spool(tmp_path, 2**20)
    for number in range(6):
        spool.append(b"record %d" % number)
    min(tmp_path.glob("*.spool")).unlink()
    with pytest.raises(FileNotFoundError):
        spool.first()
    assert spool.give_up() == 2
    assert records(spool) == [b"record %d" % number for number in range(2, 6)]
    assert spool.bytes == 0


def test_a_disk_that_takes_half_a_record_leaves_the_queue_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spool = Spool(tmp_path, 2**20)
    spool.append(b"whole")
    write, calls = os.write, []

    def half(file: int, content: bytes) -> int:
        calls.append(1)
        if len(calls) > 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(file, bytes(content)[:5])

    with monkeypatch.context() as patch:
        patch.setattr("os.write", half)
        with pytest.raises(OSError, match="No space"):
            spool.append(b"does not fit")
    assert spool.append(b"fits")
    spool = reopened(spool, tmp_path)
    assert records(spool) == [b"whole", b"fits"]
    spool.close()


def test_a_folder_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SpoolError, match="Not a directory: correct its path"):
        Spool(tmp_path / "file" / "spool", 100)
    spool = Spool(tmp_path / "spool", 100)
    with pytest.raises(SpoolError, match="another process uses"):
        Spool(tmp_path / "spool", 100)
    spool.close()
