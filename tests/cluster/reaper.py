"""Kills what a killed test run leaves behind.

A test run that is killed cannot stop its processes any more. So one small process reads, from a pipe that only the test
run holds, which processes live: `+<pid>` started, `-<pid>` ended. When the pipe closes, it kills the groups of those
that are left. (PR_SET_PDEATHSIG would need no process, but it fires when the *thread* that started a child ends.)
"""

import os
import signal
import sys
from collections.abc import Iterable


def reap(messages: Iterable[str]) -> None:
    """Follow the messages to their end, then kill each process group that is left."""
    living: set[int] = set()
    for message in messages:
        pid = int(message[1:])
        if message[0] == "+":
            living.add(pid)
        else:
            living.discard(pid)
    for pid in living:
        try:
            os.killpg(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue


if __name__ == "__main__":
    reap(sys.stdin)
