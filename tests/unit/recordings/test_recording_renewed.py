"""An episode that never ends: its recordings follow each other without a gap."""

from __future__ import annotations

from pathlib import Path

import pytest

from detector.actions.episode import Completion, OutcomeState
from tests.recording_bench import (
    Bench,
    Recorded,
    an_episode,
    as_recorded,
    mcap_files,
    metadata_of,
    pose,
    read_with_mcap,
    speed,
    tf_static,
)


def recorded(path: Path) -> list[list[Recorded]]:
    folders = sorted(each for each in (path / "r").iterdir() if not each.name.startswith("."))
    return [[each for file in mcap_files(folder) for each in read_with_mcap(file)] for folder in folders]


@pytest.mark.parametrize("batch", [1, 7, 1000])
def test_each_sample_is_in_exactly_one_recording(tmp_path: Path, batch: int) -> None:
    bench = Bench(tmp_path, renewAfter="1s")
    episode = an_episode(end_time=None, reason=None)
    poses = [pose(1 + k / 50, k) for k in range(175)]
    speeds = [speed(1 + k / 50 + 0.005, k) for k in range(175)]
    latched = tf_static(0.2)
    given = sorted([*poses, *speeds], key=lambda each: each.time)
    given[60:62] = given[61], given[60]  # one is late
    bench.action.started(episode)
    bench.action.samples(episode, [latched])
    for first in range(0, len(given), batch):
        bench.action.samples(episode, given[first : first + batch])
    bench.action.completed(an_episode(), Completion())
    found = recorded(tmp_path)
    assert [len(each) for each in found] == [101, 101, 101, 51]
    in_order = [as_recorded(each) for each in sorted(given, key=lambda each: each.time)]
    for number, part in enumerate(found):
        assert part[1:] == [each for each in in_order if number + 1 <= each.time < number + 2]
    assert [part[0].payload for part in found] == [latched.payload] * 4
    outcome = bench.outcome(episode)
    assert (outcome.state, outcome.details["recordings"]) == (OutcomeState.DONE, 4)


def test_recordings_report_that_they_continue_and_are_continued(tmp_path: Path) -> None:
    bench = Bench(tmp_path, renewAfter="1s")
    bench.record(an_episode(), [pose(1.0), pose(2.5)])
    one, other = sorted((tmp_path / "r").iterdir())
    assert [each.name[-18:] for each in (one, other)] == ["_episode1_part0001", "_episode1_part0002"]
    first, second = (metadata_of(mcap_files(each)[0]) for each in (one, other))
    assert (first["wayside"]["part"], first["wayside"].get("continued")) == ("1", None)
    assert (second["wayside"]["part"], second["wayside"]["continued"]) == ("2", "true")
    assert (first["wayside/end"].get("continues"), second["wayside/end"].get("continues")) == ("true", None)


def test_the_oldest_recordings_are_dropped_while_the_episode_lasts(tmp_path: Path) -> None:
    bench = Bench(tmp_path, renewAfter="1s")
    bench.limit(files=3)
    bench.record(an_episode(), [pose(1 + k / 10, k) for k in range(60)])
    assert [each.name[-4:] for each in sorted((tmp_path / "r").iterdir())] == ["0004", "0005", "0006"]
    assert bench.outcome(an_episode()).state is OutcomeState.DONE


def test_recording_is_retried_after_a_failure(tmp_path: Path) -> None:
    bench = Bench(tmp_path, renewAfter="1h")
    bench.limit(bytes="1k", whenFull="Stop")
    bench.action.started(an_episode())
    bench.action.samples(an_episode(), [tf_static(0.5), pose(1.1)])
    bench.limit(bytes="1G")
    bench.action.samples(an_episode(), [pose(5.0)])
    bench.action.samples(an_episode(), [pose(12.0), pose(13.0)])
    bench.action.completed(an_episode(), Completion())
    assert [[each.time for each in part] for part in recorded(tmp_path)] == [[12.0, 13.0]]
    assert sum(count for _, count, _ in bench.lost) == 3
    assert bench.outcome(an_episode()).state is OutcomeState.FAILED
