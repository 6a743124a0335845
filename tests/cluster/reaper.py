"""Cleans up after a killed test run.

A test run that is killed cannot stop its processes any more. So one small process reads, from a pipe that only the test
run holds, what there is: `+<pid>` a process started, `-<pid>` it ended, `/<path>` a folder to remove. When the pipe
closes, it kills the groups of the processes that are left and removes the folders that are. (PR_SET_PDEATHSIG would
need no process, but it fires when the *thread* that started a child ends.)
"""

import os
import shutil
import signal
import sys
import time
from collections.abc import Iterable

ATTEMPTS = 50  # at 0.1 s: a killed process may still write for a moment


def reap(messages: Iterable[str]) -> None:
    """Follow the messages to their end, then kill each process group and remove each folder that is left."""
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
