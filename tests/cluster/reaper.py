"""Cleans up after a killed test run.

A killed test run cannot stop its processes. So one small process reads messages from a pipe that only the test run
holds: `+<pid>` a process started, `-<pid>` it ended, `/<path>` a folder to remove. When the pipe closes, it kills the
groups of the remaining processes and removes the remaining folders. (PR_SET_PDEATHSIG would need no process,
but it fires when the *thread* that started a child ends.)
"""

import os
import shutil
import signal
import sys
import time
from collections.abc import Iterable

ATTEMPTS = 50  # at 0.1 s: a killed process may still write for a moment


def reap(messages: Iterable[str]) -> None:
    """Read the messages to their end, then kill each remaining process group and remove each remaining folder."""
    living: set[int] = set()
    folders: set[str] = set()
    for message in messages:
        match message[0]:
            case "+":
                living.add(int(message[1:]))
            case "-":
                living.discard(int(message[1:]))
            case "/":
                folders.add(message.rstrip("\n"))
    for pid in living:
        try:
            os.killpg(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue
    for folder in folders:
        for _ in range(ATTEMPTS):
            shutil.rmtree(folder, ignore_errors=True)
            if not os.path.exists(folder):
                break
            time.sleep(0.1)


if __name__ == "__main__":
    reap(sys.stdin)
