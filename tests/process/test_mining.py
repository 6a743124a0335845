"""`detector mine`: one dataset from many recordings, even if worker processes are killed."""

from __future__ import annotations

import contextlib
import functools
import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import dask
import duckdb
import pyarrow.parquet as pq
import pytest
from distributed import LocalCluster

from detector.commands.cli import app
from detector.commands.replay import replay_files
from detector.mining.dask import DaskWorkers
from detector.mining.workers import LocalWorkers, LostWorker, RemoteCall
from detector.results.kinds import ResultKind
from tests import s3
from tests.cluster.waiting import wait_until
from tests.fleets import HARSH, write_fleet, write_mcap
from tests.patience import PATIENCE
from wayside.process import commandline

pytestmark = pytest.mark.xdist_group("mining")  # one fleet for all tests

RECORDINGS, BROKEN = 6, 3


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a Detector, rules and recordings, and their dataset `out`, made by two processes."""
    folder = tmp_path_factory.mktemp("fleet")
    write_fleet(folder, RECORDINGS, 40.0, BROKEN)
    assert f"{RECORDINGS + BROKEN} mined now" in mine(folder, "out", "--processes", "2")
    return folder


def command(folder: Path, output: str, *options: str, rules: str = "rules.yaml", drives: str = "drives") -> list[str]:
    given = ["mine", drives, "--detector", "detector.yaml", "--rules", rules, "--output", output]
    return [sys.executable, "-m", "detector.commands.cli", *given, *options]


def mine(folder: Path, output: str, *options: str, **more: Any) -> str:
    """Run the command in this process, with its own worker processes; return its output."""
    logged = io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stderr(logged):
        commandline.run_cli(app, "detector", (), command(folder, output, *options, **more)[3:])
    return logged.getvalue()


def files(dataset: Path) -> dict[str, bytes]:
    """The dataset, byte by byte."""
    return {
        str(path.relative_to(dataset)): path.read_bytes()
        for path in sorted(dataset.rglob("*.parquet"))
        if ".cache" not in path.parts
    }


def requested(folder: Path, question: str) -> list[tuple[Any, ...]]:
    """The result of a DuckDB query in that folder."""
    with duckdb.connect() as database:
        table = database.sql(re.sub("'(?=[a-z0-9]+/)", f"'{folder}/", question)).to_arrow_table()
        return [tuple(row.values()) for row in table.to_pylist()]


def test_episodes_are_those_of_a_replay_of_each_recording(fleet: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(fleet)
    paths = sorted(Path("drives").glob("car-*"))
    replay_files(
        paths,
        Path("replayed"),
        Path("detector.yaml"),
        [Path("rules.yaml")],
        as_one=False,
        kinds=frozenset({ResultKind.EPISODES}),
    )
    names = pq.read_schema(fleet / "replayed/episodes.parquet").names
    columns = ", ".join(f'"{name}"' for name in names if name != "episode")  # the holder differs
    order = "ORDER BY recording, rule, start_time, subject"
    expected = requested(fleet, f"SELECT {columns} FROM 'replayed/episodes.parquet' {order}")
    found = requested(fleet, f"SELECT {columns} FROM 'out/episodes/*/*.parquet' WHERE recording LIKE '%car-%' {order}")
    assert len(expected) > 100
    assert found == expected
    assert requested(fleet, "SELECT count(DISTINCT episode), count(*) FROM 'out/episodes/*/*.parquet'") == [
        (len(requested(fleet, "FROM 'out/episodes/*/*.parquet'")),) * 2
    ]


def test_near_misses_are_those_of_a_replay_and_are_printed(fleet: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(fleet)
    path = sorted(Path("drives").glob("car-*"))[0]
    replay_files(
        [path],
        Path("alone"),
        Path("detector.yaml"),
        [Path("rules.yaml")],
        as_one=False,
        kinds=frozenset({ResultKind.EPISODES}),
    )
    columns = "rule, subject, CAST(time AS TIMESTAMPTZ), margin"
    expected = requested(fleet, f"SELECT {columns} FROM 'alone/nearest.csv'")
    found = requested(fleet, f"SELECT {columns} FROM 'out/nearest.parquet' WHERE recording LIKE '%{path.name}'")
    assert {rule for rule, *_ in expected} == {"close"}
    assert found == expected
    ((highest,),) = requested(fleet, "SELECT max(margin) FROM 'out/nearest.parquet'")
    title, printed = mine(fleet, "out").partition("nearest without an episode")[1:]
    assert title
    assert f"{highest:.3g}" in printed
    assert "Nearest without an episode" in (fleet / "out/report.html").read_text()


def test_the_query_of_the_guide_gives_its_result(fleet: Path) -> None:
    guide = (Path(__file__).parents[2] / "docs/mining.md").read_text()
    (question,) = re.findall(r"```sql\n(.*?);\n```", guide, re.DOTALL)
    rows = requested(fleet, question)
    assert [name for name, *_ in rows] == [name for name, _, _ in sorted(rows, key=lambda row: (-row[1], row[0]))]
    ((fast, longest),) = requested(
        fleet, "SELECT count(*), max(\"speed.max\") FROM 'out/episodes/rule=too-fast/*.parquet'"
    )
    ((hours,),) = requested(fleet, "SELECT sum(duration) / 3600 FROM 'out/recordings.parquet'")
    assert sum(row[1] for row in rows) == pytest.approx(fast / hours, rel=0.01)
    assert max(row[2] for row in rows) == round(longest, 1)


def test_broken_recordings_are_listed_with_their_reason(fleet: Path) -> None:
    found = requested(fleet, "SELECT recording, kind, message FROM 'out/errors.parquet'")
    assert [(name, kind) for name, kind, _ in found] == [
        ("drives/broken-000-drive.mcap", "unreadable"),
        ("drives/broken-001-drive.jsonl", "unreadable"),
        ("drives/broken-002-drive.mcap", "cut"),
    ]
    assert "is not a recording that Wayside can read" in found[0][2]
    assert "broken-001-drive.jsonl:" in found[1][2]
    assert re.search(r"the recording is cut \(.*\): it contains [1-9]\d* messages", found[2][2])
    assert requested(fleet, "SELECT count(*) FROM 'out/recordings.parquet' WHERE samples > 0") == [(RECORDINGS + 1,)]
    assert requested(fleet, "SELECT count(*), sum(samples) > 0 FROM 'out/streams.parquet'") == [(RECORDINGS + 1, True)]


def test_one_process_and_shares_give_the_same_bytes(fleet: Path) -> None:
    mine(fleet, "one", "--processes", "1")
    assert files(fleet / "one") == files(fleet / "out")
    first = mine(fleet, "shared", "--processes", "1", "--share", "0/2")
    assert "other shares are not finished yet" in first
    assert not files(fleet / "shared")
    mine(fleet, "shared", "--processes", "1", "--share", "1/2")
    assert files(fleet / "shared") == files(fleet / "out")


def test_a_second_run_reuses_all_results_and_a_changed_rule_is_evaluated_alone(fleet: Path) -> None:
    def times() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in (fleet / "out").rglob("*")}

    before = times()
    assert "nothing left to mine" in mine(fleet, "out")
    assert times() == before
    changed = (fleet / "rules.yaml").read_text().replace("cooldown: 2s", "cooldown: 3s")
    assert changed.count("cooldown: 3s") == 1
    (fleet / "changed.yaml").write_text(changed)
    mine(fleet, "again")
    ran = mine(fleet, "again", rules="changed.yaml")
    assert f"{RECORDINGS + BROKEN} mined now, with harsh:" in ran
    mine(fleet, "fresh", rules="changed.yaml")
    assert files(fleet / "again") == files(fleet / "fresh")
    different = [name for name, data in files(fleet / "again").items() if data != files(fleet / "out")[name]]
    assert different == ["episodes/rule=harsh/part-0.parquet", "rules.parquet"]
    (fleet / "harsh.yaml").write_text(HARSH)
    assert "nothing left to mine" in mine(fleet, "again", rules="harsh.yaml")
    assert [name for name in files(fleet / "again") if "rule=" in name] == ["episodes/rule=harsh/part-0.parquet"]


def test_a_long_recording_is_split_for_rules_that_permit_exact_splits(fleet: Path) -> None:
    (fleet / "long").mkdir()
    write_mcap(fleet / "long" / "drive.mcap", 7, 600.0, cars=2)
    logged = mine(fleet, "cut", "--processes", "2", drives="long")
    assert "long/drive.mcap: cut into 3 pieces; not cut for close (pairs)" in logged
    assert "pieces" not in mine(fleet, "uncut", "--processes", "1", drives="long")
    assert files(fleet / "cut") == files(fleet / "uncut")
    ((episodes,),) = requested(fleet, "SELECT count(*) FROM 'cut/episodes/*/*.parquet'")
    assert episodes > 200


def test_clips_are_linked_from_the_episodes_and_the_report(fleet: Path) -> None:
    action = """
  actions: [{name: clip, record: {streams: [odom], before: 1s, after: 1s}}]"""
    (fleet / "record.yaml").write_text(HARSH.rstrip() + action)
    drive = "drives/car-000-drive.mcap"
    mine(fleet, "clips", "--record", rules="record.yaml", drives=drive)
    found = requested(fleet, "SELECT episode, clips FROM 'clips/episodes/*/*.parquet'")
    page = (fleet / "clips" / "report.html").read_text()
    assert len(found) > 3
    for episode, (clip,) in found:
        description = json.loads((fleet / "clips" / clip / "recording.json").read_text())
        assert (description["episode"], description["rule"]) == (episode, "harsh")
        assert f'<a href="{clip}/">' in page.replace("%7E", "~")
    changed = (fleet / "record.yaml").read_text().replace("cooldown: 2s", "cooldown: 60s")
    (fleet / "record.yaml").write_text(changed)
    mine(fleet, "clips", "--record", rules="record.yaml", drives=drive)
    kept = requested(fleet, "SELECT clips FROM 'clips/episodes/*/*.parquet'")
    assert 0 < len(kept) < len(found)
    assert {clip for (of_one,) in kept for clip in of_one} == {
        str(path.parent.relative_to(fleet / "clips")) for path in (fleet / "clips" / "clips").rglob("recording.json")
    }


def test_a_worker_that_is_killed_changes_nothing(fleet: Path) -> None:
    run = subprocess.Popen(command(fleet, "killed", "--processes", "2"), cwd=fleet, stderr=subprocess.PIPE, text=True)
    mined = fleet / "killed" / ".cache" / "mined"
    wait_until(lambda: mined.is_dir() and [*map(str, mined.iterdir())], bool, what="a recording is mined")
    os.kill(workers_of(run.pid)[0], signal.SIGKILL)
    _, logged = run.communicate(timeout=300)
    assert f"{RECORDINGS + BROKEN} mined now" in logged
    assert files(fleet / "killed") == files(fleet / "out")


def test_a_dask_cluster_of_which_a_worker_is_killed_gives_the_same(fleet: Path) -> None:
    # A local cluster drops a worker that does not restart in time, and a busy machine starts it slowly.
    back = dask.config.set({"distributed.deploy.lost-worker-timeout": PATIENCE})
    with back, LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        calls = [RemoteCall(end_once, str(fleet / "ended"))] + [RemoteCall(end, number) for number in range(3)]
        workers = DaskWorkers(cluster.scheduler_address)
        assert sorted(result for _, result in workers.run(calls)) == [-1, 0, 1, 2]
        ((_, lost),) = workers.run([RemoteCall(end, 3)])
        assert isinstance(lost, LostWorker)
        workers.close()
        assert f"{RECORDINGS + BROKEN} mined now" in mine(fleet, "dask", "--dask", cluster.scheduler_address)
    assert files(fleet / "dask") == files(fleet / "out")


def end_once(path: str) -> int:
    """Ends the first process that calls it."""
    if not Path(path).exists():
        Path(path).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return -1


def test_recordings_behind_urls_are_mined_like_local_files(fleet: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    columns = 'subject, start_time, end_time, reason, rule, "speed.max"'
    expected = requested(fleet, f"SELECT {columns} FROM 'out/episodes/*/*.parquet' ORDER BY ALL")
    drives = [*sorted((fleet / "drives").iterdir())]
    with s3.running() as environment:
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        for path in drives:
            s3.put(environment, f"2026/{path.name}", path.read_bytes())
        url = f"s3://{s3.BUCKET}/2026"
        assert f"{len(drives)} mined now" in mine(fleet, "s3", drives=f"{url}/*")
        assert requested(fleet, f"SELECT {columns} FROM 's3/episodes/*/*.parquet' ORDER BY ALL") == expected
        names = [row[0] for row in requested(fleet, "SELECT recording FROM 's3/recordings.parquet'")]
        assert names == [f"{url}/{path.name}" for path in drives]
        assert "nothing left to mine" in mine(fleet, "s3", drives=url)
        s3.put(environment, f"2026/{drives[0].name}", drives[-1].read_bytes())
        assert "1 mined now" in mine(fleet, "s3", drives=url)
    with serving(fleet) as address:
        (fleet / "list.txt").write_text("".join(f"{address}/drives/{path.name}\n" for path in drives))
        (fleet / "list.txt").open("a").write(f"{address}/drives/none.mcap\n")
        assert "none.mcap: there is no such file" in mine(fleet, "http", drives="@list.txt")
        assert "nothing left to mine" in mine(fleet, "http", drives=f"{address}/drives/")
    assert requested(fleet, f"SELECT {columns} FROM 'http/episodes/*/*.parquet' ORDER BY ALL") == expected


@contextlib.contextmanager
def serving(folder: Path) -> Iterator[str]:
    """Serve the folder over HTTP; yields the address."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def workers_of(process: int) -> list[int]:
    """Its worker processes."""
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return [int(child) for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


def end(number: int) -> int:
    """Ends the calling process for one of the numbers."""
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def test_a_call_that_kills_its_worker_fails_alone() -> None:
    pool = LocalWorkers(2)
    try:
        found = {call.argument: result for call, result in pool.run(RemoteCall(end, number) for number in range(8))}
    finally:
        pool.close()
    assert isinstance(found.pop(3), LostWorker)
    assert found == {number: number for number in range(8) if number != 3}
