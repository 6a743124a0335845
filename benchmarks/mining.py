"""The gain of mining with processes, the overhead of Dask, and identical datasets from each way of mining.

A seeded generator writes 200 recordings (MCAP and JSON lines, some broken, one of an hour). They are mined by one
process, by two, by a Dask cluster of two worker processes, and by two processes of which one is killed: the datasets
are the same, byte by byte. A second run does nothing, and a changed rule runs alone. Then the hour alone is mined whole
and cut. Figures are wall clock times; aims: two processes at least 1.7 times as fast as one on two cores, Dask with the
settings of docs/mining.md at most 1.1 times the pool, cut faster than whole. Dask with its defaults is measured too.

    python -m benchmarks.mining [--recordings 200] [--seconds 120] [--hour 3600]
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import dask
from distributed import LocalCluster

from tests.cluster.waiting import wait_until
from tests.fleets import CLOSE, HARSH, TOO_FAST, write_fleet, write_mcap

BROKEN = 9
GAIN, DASK = 1.7, 1.1
SETTINGS = {"distributed.worker.profile.enabled": False, "distributed.admin.tick.interval": "1s"}
"""Of Dask's workers, as docs/mining.md recommends: both interrupt the calls, up to a hundred times a second."""


def main() -> int:
    """Measure and print; 1 means that datasets differ or an aim is missed."""
    parser = argparse.ArgumentParser(prog="mining", description=__doc__)
    parser.add_argument("--recordings", type=int, default=200, help="(%(default)s)")
    parser.add_argument("--seconds", type=float, default=120, help="of data in each (%(default)s)")
    parser.add_argument("--hour", type=float, default=3600, help="seconds of data in the long one (%(default)s)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        drives = write_fleet(folder, options.recordings - BROKEN - 1, options.seconds, BROKEN)
        long = write_mcap(drives / "long-drive.mcap", 5000, options.hour)
        good = fleet(folder)
        (folder / "hour").mkdir()
        long.rename(folder / "hour" / long.name)
        (folder / "rules.yaml").write_text("---".join((TOO_FAST, HARSH)))
        whole, cut = timed(folder, "whole", ["--processes", "1"], "hour"), timed(folder, "cut", [], "hour")
        same = files(folder / "whole") == files(folder / "cut")
        print(
            f"{options.hour:.0f} s alone: whole, 1 process {whole:.1f} s; cut, 2 processes {cut:.1f} s: "
            f"{whole / cut:.2f} times as fast"
        )
    return 0 if good and same and cut < whole else 1


def fleet(folder: Path) -> bool:
    """All recordings, each way; whether datasets are the same and the aims are met."""
    one = timed(folder, "one", ["--processes", "1"])
    two = timed(folder, "two", ["--processes", "2"])
    with dask.config.set(SETTINGS):
        tuned = on_dask(folder, "dask")
    untuned = on_dask(folder, "untuned")
    killed(folder)
    again = timed(folder, "two", [])
    print(f"1 process {one:.1f} s; 2 processes {two:.1f} s: {one / two:.2f} times as fast (aim {GAIN})")
    print(f"Dask, 2 workers {tuned:.1f} s: {tuned / two:.2f} times the pool (aim {DASK})")
    print(f"Dask with its defaults {untuned:.1f} s: {untuned / two:.2f} times the pool; a second run {again:.1f} s")
    reference = files(folder / "one")
    same = all(files(folder / other) == reference for other in ("two", "dask", "untuned", "killed"))
    print(f"datasets of 1 process, 2 processes, Dask and a killed worker: {'the same' if same else 'DIFFERENT'}")
    (folder / "changed.yaml").write_text("---".join((TOO_FAST, HARSH.replace("cooldown: 2s", "cooldown: 3s"), CLOSE)))
    changed = timed(folder, "two", ["--rules", "changed.yaml"])
    other = [name for name, data in files(folder / "two").items() if data != reference[name]]
    print(f"a changed rule {changed:.1f} s; files that changed: {', '.join(other)}")
    return same and one / two >= GAIN and tuned / two <= DASK


def on_dask(folder: Path, output: str) -> float:
    """Seconds on a cluster of two workers that have imported all."""
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        timed(folder, f"{output}-warm", ["--dask", cluster.scheduler_address, "--limit", "4"])
        return timed(folder, output, ["--dask", cluster.scheduler_address])


def command(folder: Path, output: str, options: list[str], drives: str = "drives") -> list[str]:
    rules = [] if "--rules" in options else ["--rules", "rules.yaml"]
    given = ["mine", drives, "--detector", "detector.yaml", *rules, "--output", output, *options]
    return [sys.executable, "-m", "detector.commands.cli", *given]


def timed(folder: Path, output: str, options: list[str], drives: str = "drives") -> float:
    """Seconds."""
    begin = time.monotonic()
    done = subprocess.run(
        command(folder, output, options, drives), cwd=folder, stderr=subprocess.PIPE, text=True, check=False
    )
    print(f"  {output}: {done.stderr.splitlines()[-1]}", flush=True)
    return time.monotonic() - begin


def killed(folder: Path) -> None:
    """Mine with two processes, of which one is killed in the middle."""
    run = subprocess.Popen(command(folder, "killed", ["--processes", "2"]), cwd=folder, stderr=subprocess.DEVNULL)
    mined = folder / "killed" / ".cache" / "mined"
    wait_until(lambda: mined.is_dir() and len([*mined.iterdir()]), lambda count: count > 20, what="20 are mined")
    children = Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()
    workers = [int(each) for each in children if b"spawn_main" in Path(f"/proc/{each}/cmdline").read_bytes()]
    os.kill(workers[0], signal.SIGKILL)
    run.wait()


def files(dataset: Path) -> dict[str, bytes]:
    """The dataset, byte by byte."""
    paths = [path for path in sorted(dataset.rglob("*.parquet")) if ".cache" not in path.parts]
    return {str(path.relative_to(dataset)): path.read_bytes() for path in paths}


if __name__ == "__main__":
    sys.exit(main())
