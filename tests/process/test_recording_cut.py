"""Truncated recordings: a killed process, a full disk, a failing disk."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.actions.base import ActionError
from detector.actions.episode import Completion, OutcomeState
from detector.actions.outcomes import ActionKey, Outcomes
from detector.actions.record.destination import Destination
from detector.actions.record.recovery import contents_of, recover, salvage
from detector.actions.worker import Worker
from detector.engine.consequences import ActionRun, RunCompleted, RunSamples, RunStarted
from detector.engine.episodes.events import Event
from detector.engine.episodes.record import EpisodeRecord
from detector.engine.episodes.rendering import Rendered
from tests.driving import at
from tests.patience import PATIENCE
from tests.recording_bench import (
    Bench,
    a_sample,
    an_episode,
    as_recorded,
    mcap_files,
    metadata_of,
    pose,
    read_with_mcap,
    read_with_rosbags,
    speed,
    tf_static,
)
from wayside.api.recordings import Recordings

SAMPLES = [tf_static(0.1), *(each for k in range(200) for each in (pose(1 + k / 100, k), speed(1 + k / 100, k)))]
MEGABYTE = os.urandom(1_000_000)

KILLED = """
import sys, time
from pathlib import Path
from tests.recording_bench import Bench, an_episode
from tests.process.test_recording_cut import SAMPLES
from detector.actions.episode import Completion

bench = Bench(Path(sys.argv[1]), before="1s", compression=sys.argv[2], split={"duration": "500ms"})
bench.record(an_episode(1), SAMPLES)
bench.action.started(an_episode(2))
bench.action.samples(an_episode(2), SAMPLES[:150])
bench.action.wake()  # hands to the kernel what there is
bench.action.started(an_episode(3))
bench.action.samples(an_episode(3), SAMPLES[:1])
bench.action.samples(an_episode(2), SAMPLES[150:190])
print("recording", flush=True)
time.sleep(60)
"""


def recovered(path: Path) -> Bench:
    """A restarted action that has recovered unfinished recordings."""
    bench = Bench(path)
    bench.action.wake()
    for thread in threading.enumerate():
        if thread.name == "recordings-recovery":
            thread.join(PATIENCE)
            assert not thread.is_alive()
    return bench


@pytest.mark.parametrize("compression", ["None", "Lz4", "Zstd"])
def test_the_recording_of_a_killed_process_is_recovered_and_marked(tmp_path: Path, compression: str) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(tmp_path), compression],
        stdout=subprocess.PIPE,
        cwd=Path(__file__).parents[2],
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "recording\n"
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    (left, other) = sorted(each for each in (tmp_path / "r").iterdir() if each.name.startswith("."))
    assert ".partial" in left.name
    bench = recovered(tmp_path)
    names = sorted(each.name for each in (tmp_path / "r").iterdir())
    assert [name.split("_")[4:] for name in names] == [["episode1"], ["episode2", "cut"]]
    assert not other.exists()  # no sample of it had been written
    assert read_with_rosbags(tmp_path / "r" / names[0])
    cut = tmp_path / "r" / names[1]
    found = {each for file in mcap_files(cut) for each in read_with_mcap(file)}
    written = set(map(as_recorded, SAMPLES[1:150]))
    assert written <= found
    assert {each.topic for each in found - written} <= {each.topic for each in map(as_recorded, SAMPLES)}
    assert metadata_of(mcap_files(cut)[-1])["cut"] == {"reason": "the detector was killed while it recorded"}
    assert (
        len(read_with_rosbags(cut)) == sum("speed" not in each.topic for each in map(as_recorded, SAMPLES[1:150])) + 2
    )
    assert bench.lost == [("recordings cut short", 1, "the detector was killed while it recorded")]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[int]]:
    """A file of small chunks, and the offset of each one's end."""
    bench = Bench(tmp_path_factory.mktemp("whole"))
    bench.action.started(an_episode())
    for first in range(0, len(SAMPLES), 40):
        bench.action.samples(an_episode(), SAMPLES[first : first + 40])
        bench.action._open["episode1"].series.flush()
    bench.action.completed(an_episode(), Completion())
    (file,) = mcap_files(bench.folder(an_episode()))
    contents = contents_of(file)
    assert contents is not None
    return file, [chunk.chunk_start_offset + chunk.chunk_length for chunk in contents.chunks]


@settings(deadline=None, max_examples=60)
@given(st.data())
def test_a_truncated_file_gives_all_chunks_before_the_cut(whole: tuple[Path, list[int]], data: st.DataObject) -> None:
    file, ends = whole
    size = file.stat().st_size
    cut = data.draw(st.one_of(st.integers(0, size), st.sampled_from(ends).map(lambda end: end + 5)))
    path = file.with_name("cut.mcap")
    shutil.copy(file, path)
    os.truncate(path, cut)
    if data.draw(st.booleans()) and cut > 200:  # a block that never reached the disk
        with path.open("r+b") as stream:
            stream.seek(cut - 10)
            stream.write(bytes(10))
        cut -= 10
    found = salvage(path, lambda now, later: None)
    whole_chunks = sum(end <= cut for end in ends)
    if found is None:
        assert whole_chunks == 0
        return
    found.add_metadata("cut", {"reason": "test"})
    found.finish()
    messages = read_with_mcap(path)
    everything = read_with_mcap(file)
    assert len(messages) >= 40 * whole_chunks - (len(everything) < 40 * whole_chunks) * 40
    assert messages == everything[: len(messages)]
    assert len(read_with_rosbags(path)) == len(messages)


def test_a_recording_that_another_process_makes_is_left_alone(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.action.started(an_episode())
    bench.action.samples(an_episode(), SAMPLES)
    (busy,) = (tmp_path / "r").iterdir()
    place = Destination(Recordings.model_validate({"path": str(tmp_path)}))
    assert recover(place, place.take_unfinished()) == []
    bench.action.completed(an_episode(), Completion())
    assert not busy.exists()
    assert bench.outcome(an_episode()).state is OutcomeState.DONE


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """4 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(disk)]
    if os.geteuid() != 0 or subprocess.run(mount, check=False).returncode:
        pytest.skip("a disk of its own needs root")
    yield disk
    subprocess.run(["umount", "--lazy", disk], check=True)  # a process may still use it


def somebody_else_fills_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the check of the free space and the write."""
    monkeypatch.setattr(Destination, "_free", lambda self: 10**12)


def test_a_full_disk_truncates_the_recording_and_affects_nothing_else(
    small_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    somebody_else_fills_the_disk(monkeypatch)
    bench = Bench(small_disk)
    points = [a_sample(1 + k / 10, "points", MEGABYTE) for k in range(8)]
    folder = bench.record(an_episode(1), points)
    outcome = bench.outcome(an_episode(1))
    assert (outcome.state, folder.name.endswith("_cut")) == (OutcomeState.FAILED, True)
    assert "No space left on device" in outcome.message
    (file,) = mcap_files(folder)
    found = read_with_mcap(file)
    assert found == list(map(as_recorded, points[: len(found)]))
    assert outcome.samples == len(found) >= 2
    assert outcome.samples + outcome.missing == len(points)
    assert "No space left on device" in metadata_of(file)["cut"]["reason"]
    shutil.rmtree(folder)
    assert bench.record(an_episode(2), points[:2])
    assert bench.outcome(an_episode(2)).state is OutcomeState.DONE


def test_the_reserve_of_free_space_is_kept(small_disk: Path) -> None:
    bench = Bench(small_disk)
    bench.limit(reserve="1M")
    for number in range(1, 5):
        bench.record(an_episode(number), [a_sample(1 + k / 10, "points", MEGABYTE) for k in range(2)])
        stat = os.statvfs(small_disk)
        assert stat.f_bavail * stat.f_frsize >= 1_000_000
        assert bench.outcome(an_episode(number)).state is OutcomeState.DONE


def test_a_disk_that_is_full_from_the_start_is_reported(small_disk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(small_disk)
    (small_disk / "filler").write_bytes(bytes(4 * 2**20))
    with pytest.raises(ActionError, match=r"cannot start the recording: less than 0 of the disk would be free"):
        bench.action.started(an_episode())
    somebody_else_fills_the_disk(monkeypatch)
    with pytest.raises(ActionError, match=r"cannot start the recording: writing failed: .*No space left on device"):
        bench.action.started(an_episode())
    assert sorted(each.name for each in small_disk.rglob("*")) == ["filler", "r"]


def test_a_write_error_affects_only_its_recording(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    one, other = an_episode(1), an_episode(2)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    bench.action.started(one)
    bench.action.started(other)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2_500_000, limits[1]))
        bench.action.samples(one, [a_sample(1 + k / 10, "points", MEGABYTE) for k in range(5)])
        bench.action.samples(other, [pose(1.1)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert bench.outcome(one).state is OutcomeState.FAILED
    assert "File too large" in bench.outcome(one).message
    assert len(read_with_mcap(mcap_files(bench.folder(one))[0])) == 2
    bench.action.completed(one, Completion())
    bench.action.completed(other, Completion())
    assert bench.outcome(other).state is OutcomeState.DONE


def test_a_folder_that_cannot_be_made_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    bench = Bench(tmp_path / "file")
    with pytest.raises(ActionError, match="cannot start the recording: writing failed"):
        bench.action.started(an_episode())
    assert bench.action.wake() is not None


def test_a_sample_is_written_within_a_second(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.action.started(an_episode())
    bench.action.samples(an_episode(), SAMPLES[:5])
    deadline = time.monotonic() + PATIENCE
    while bench.action._open["episode1"].series.waiting and time.monotonic() < deadline:
        assert bench.action.wake() is not None
    assert not bench.action._open["episode1"].series.waiting
    bench.action.close()


def test_a_slow_disk_drops_and_counts_samples_and_delays_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    proceed, write = threading.Event(), os.pwritev

    def slowly(*arguments: Any) -> int:
        proceed.wait(PATIENCE)
        return write(*arguments)

    monkeypatch.setattr("os.pwritev", slowly)
    bench = Bench(tmp_path)
    published: list[dict[str, Any]] = []
    outcomes = Outcomes("h", lambda key, payload, encoding: published.append(json.loads(payload)), lambda: at(0))
    which = ActionKey("r", "bag")
    outcomes.register(which, "record")
    bench.action.context = replace(bench.action.context, report=partial(outcomes.report, which))
    worker = Worker(which, lambda: bench.action, outcomes, maximum_bytes=5_500_000)
    run = ActionRun("r", "bag", "episode1")
    begun = Event("h", EpisodeRecord("episode1", "r", "car1", ("car1",), None, at(1), at(1), {}, None), {})
    points = [a_sample(1 + k / 10, "points", MEGABYTE) for k in range(8)]
    begin = time.monotonic()
    worker.enqueue(RunStarted(run, begun, Rendered(), resumed=False))
    for sample in points:
        worker.enqueue(RunSamples(run, [sample]))
    worker.enqueue(RunCompleted(run))
    assert time.monotonic() - begin < PATIENCE / 2  # the disk stalls for twice as long
    proceed.set()
    worker.request_close()
    assert worker.join(PATIENCE)
    loss_counter = outcomes.counts_by_action()[which]
    assert (loss_counter.failed, loss_counter.samples, loss_counter.missing) == (1, 5, 3)
    (folder,) = (tmp_path / "r").iterdir()
    assert folder.name.endswith("_cut")
    assert read_with_mcap(mcap_files(folder)[0]) == list(map(as_recorded, points[:5]))
    assert published[-1]["data"]["message"] == "3 samples of the window are missing"


def test_an_unsynced_recording_is_recovered_at_the_next_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(tmp_path)
    bench.action.started(an_episode())
    bench.action.samples(an_episode(), SAMPLES)

    def broken(fd: int) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patched:
        patched.setattr("os.fsync", broken)
        bench.action.completed(an_episode(), Completion())
    outcome = bench.outcome(an_episode())
    assert outcome.state is OutcomeState.FAILED
    assert "cannot complete the recording; the next start retries: [Errno 5] Input/output error" in outcome.message
    assert [each.name[0] for each in (tmp_path / "r").iterdir()] == ["."]
    place = Destination(Recordings.model_validate({"path": str(tmp_path)}))
    (kept,) = recover(place, place.take_unfinished())
    assert kept.path.name.endswith("_cut")
    (file,) = mcap_files(kept.path)
    assert sorted(each.payload for each in read_with_mcap(file)) == sorted(each.payload for each in SAMPLES)
    assert "cut" in metadata_of(file)
