"""The total size of recordings is limited, and the oldest are dropped for new ones."""

from __future__ import annotations

import contextlib
import os
import threading
from pathlib import Path

import pytest

from detector.actions.base import ActionError
from detector.actions.episode import Completion, OutcomeState
from tests.driving import a_stream
from tests.recording_bench import (
    STREAMS,
    Bench,
    a_sample,
    an_episode,
    mcap_files,
    metadata_of,
    pose,
    read_with_mcap,
)

MEGABYTE = os.urandom(1_000_000)
THREE = [a_sample(1 + k / 10, "points", MEGABYTE) for k in range(3)]


def recordings_of(path: Path) -> list[str]:
    """The episodes that have a recording, cut or not."""
    return sorted(each.name.split("_")[4] for each in path.glob("*/*") if not each.name.startswith("."))


def taken(path: Path) -> int:
    return sum(each.stat().st_size for each in path.rglob("*") if each.is_file())


def test_the_oldest_recordings_are_dropped_for_new_ones(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.limit(bytes="7M")
    for number in range(1, 6):
        bench.record(an_episode(number), THREE)
        assert taken(tmp_path) <= 7_000_000
    assert recordings_of(tmp_path) == ["episode4", "episode5"]
    assert sum(count for what, count, _ in bench.lost if what == "recordings") == 3


def test_the_limit_is_over_the_recordings_of_all_rules(tmp_path: Path) -> None:
    one, other = Bench(tmp_path, rule="one"), Bench(tmp_path, rule="other")
    one.limit(bytes="4M")
    other.limit(bytes="4M")
    one.record(an_episode(1, rule="one"), THREE)
    other.record(an_episode(2, rule="other"), THREE)
    assert recordings_of(tmp_path) == ["episode2"]


def test_policy_stop_keeps_existing_recordings_and_reports_it(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.limit(bytes="5M", whenFull="Stop")
    bench.record(an_episode(1), THREE)
    cut = bench.record(an_episode(2), THREE)
    assert recordings_of(tmp_path) == ["episode1", "episode2"]
    assert taken(tmp_path) <= 5_000_000
    outcome = bench.outcome(an_episode(2))
    assert (outcome.state, outcome.samples, outcome.missing) == (OutcomeState.FAILED, 1, 2)
    assert "spec.recordings.bytes (5M); whenFull is Stop" in outcome.message
    (file,) = mcap_files(cut)
    assert [each.payload for each in read_with_mcap(file)] == [MEGABYTE]
    assert metadata_of(file)["cut"] == {"reason": outcome.message}


def test_space_freed_from_outside_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(tmp_path)
    bench.limit(bytes="4M", whenFull="Stop")
    first = bench.record(an_episode(1), THREE)
    for each in first.iterdir():
        each.unlink()
    first.rmdir()
    monkeypatch.setattr("detector.actions.record.destination._SCAN_SECONDS", 0.0)
    bench.record(an_episode(2), THREE)
    assert bench.outcome(an_episode(2)).state is OutcomeState.DONE


def test_a_recording_in_progress_is_never_dropped(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.limit(bytes="5M")
    bench.action.started(an_episode(1))
    bench.action.samples(an_episode(1), THREE)
    bench.record(an_episode(2), THREE)  # finds room for one sample beside it
    bench.action.completed(an_episode(1), Completion())
    assert bench.outcome(an_episode(1)).state is OutcomeState.DONE
    assert "no finished recording is left to delete" in bench.outcome(an_episode(2)).message


def test_samples_after_the_end_of_a_recording_are_counted(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.limit(bytes="2M", whenFull="Stop")
    bench.action.started(an_episode())
    bench.action.samples(an_episode(), THREE)
    bench.action.samples(an_episode(), THREE)
    bench.action.completed(an_episode(), Completion())
    assert bench.lost == [("samples to record", 3, "the recording ended early")]
    assert [outcome.state for _, outcome in bench.reports] == [OutcomeState.RUNNING, OutcomeState.FAILED]


def test_files_are_counted(tmp_path: Path) -> None:
    bench = Bench(tmp_path, split={"duration": "100ms"})
    bench.limit(files=4)
    for number in (1, 2):
        bench.record(an_episode(number), THREE)
    assert recordings_of(tmp_path) == ["episode2"]
    bench.limit(files=2)
    folder = bench.record(an_episode(3), THREE)
    assert "more than 2 files" in bench.outcome(an_episode(3)).message
    assert [len(read_with_mcap(file)) for file in mcap_files(folder)] == [1, 1]


def test_recordings_beyond_their_age_are_deleted(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.limit(age="1h", whenFull="Stop")
    for number, hours in ((1, 2.0), (2, 0.5)):
        description = bench.record(an_episode(number), [pose(1.1)]) / "recording.json"
        ended = description.stat().st_mtime - hours * 3600
        os.utime(description, (ended, ended))
    bench.action.wake()
    assert recordings_of(tmp_path) == ["episode2"]
    assert bench.lost == [("recordings", 1, "older than spec.recordings.age")]


def test_the_reserve_of_the_disk_is_not_touched(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.limit(reserve="999999G")
    with pytest.raises(ActionError, match=r"less than 999999G of the disk would be free \(spec\.recordings\.reserve\)"):
        bench.action.started(an_episode())
    assert taken(tmp_path) == 0


def test_other_files_are_left_alone(tmp_path: Path) -> None:
    foreign = tmp_path / "r" / "holiday"
    foreign.mkdir(parents=True)
    (foreign / "metadata.yaml").write_text("mine")
    bench = Bench(tmp_path)
    bench.limit(bytes="2M")
    bench.record(an_episode(), THREE)
    assert (foreign / "metadata.yaml").exists()


def test_many_actions_at_once_keep_to_the_limit(tmp_path: Path) -> None:
    most: list[int] = []
    streams = (*STREAMS[:1], a_stream("points", encoding="raw"))

    def drive(number: int) -> None:
        bench = Bench(tmp_path, *streams, rule=f"r{number}")
        bench.limit(bytes="12M")
        for repeated in range(5):
            episode = an_episode(10 * number + repeated, rule=f"r{number}")
            bench.action.started(episode)
            for sample in THREE:
                bench.action.samples(episode, [sample])
                most.append(sum(taken_now(tmp_path).values()))
            bench.action.completed(episode, Completion())

    threads = [threading.Thread(target=drive, args=(number,)) for number in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(most) == 45
    assert max(most) <= 12_000_000
    assert all(read_with_mcap(file) for file in tmp_path.rglob("*.mcap"))


def taken_now(path: Path) -> dict[str, int]:
    """The files and their sizes at one moment, while others write and delete: what two looks in a row find alike."""
    found, before = sizes(path), None
    while found != before:
        found, before = sizes(path), found
    return found


def sizes(path: Path) -> dict[str, int]:
    found = {}
    for folder, _, names in os.walk(path):
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                file = os.path.join(folder, name)
                found[file] = os.stat(file).st_size
    return found
