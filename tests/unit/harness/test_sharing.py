"""Workers share a server: the first one starts it, and stops it after the last one."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.patience import PATIENCE

WORKER = """
import sys
from contextlib import contextmanager
from pathlib import Path
from tests.sharing import shared

folder = Path(sys.argv[1])

@contextmanager
def server():
    (folder / "log").open("a").write("started\\n")
    yield {"port": 1234}
    (folder / "log").open("a").write("stopped\\n")

with shared(folder, "server", server) as given:
    print(given["port"], flush=True)
    sys.stdin.readline()
"""


def worker(folder: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", WORKER, str(folder)]
    started = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=os.environ)
    assert started.stdout is not None
    assert started.stdout.readline() == "1234\n"
    return started


def test_a_shared_server_starts_once_stops_after_the_last_user_and_restarts_for_later_ones(tmp_path: Path) -> None:
    log = tmp_path / "log"
    first, second = worker(tmp_path), worker(tmp_path)
    assert first.stdin is not None
    first.stdin.write("\n")
    first.stdin.flush()
    assert log.read_text() == "started\n"
    second.communicate("\n")
    assert first.wait(PATIENCE) == 0
    assert log.read_text() == "started\nstopped\n"
    worker(tmp_path).communicate("\n")
    assert log.read_text() == "started\nstopped\n" * 2


def test_a_killed_worker_blocks_no_other(tmp_path: Path) -> None:
    first, second = worker(tmp_path), worker(tmp_path)
    second.kill()
    second.communicate()
    first.communicate("\n", timeout=PATIENCE)
    assert (tmp_path / "log").read_text() == "started\nstopped\n"
