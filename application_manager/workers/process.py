"""The process that runs users' expressions: one job after the other, each within its limit of CPU time.

CEL runs in C++ and holds the global interpreter lock, so neither a thread nor an exception can end an evaluation. The
kernel can: a timer of the process's own CPU time (ITIMER_PROF) sends SIGPROF when a job exceeds its limit. The manager
recognises the signal, and starts another process. The limit is CPU time, so no job fails because the machine is busy.

Frames are a length and a pickle, on standard input and output. The process ends when its input does.
"""

from __future__ import annotations

import os
import pickle
import resource
import signal
import struct
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, BinaryIO, TypeVar

LENGTH = struct.Struct("<I")

MEMORY = 256 * 1024 * 1024
"""Bytes of data that the process may have; it has 40 MB when it starts."""

_NICENESS = 10  # if there is no idle class

Result = TypeVar("Result")
Job = Callable[[], Result]
"""A computation that depends on its own content alone, and that can be pickled."""

FAILED = -1.0
"""Sent in place of the CPU time: the job raised an error, a defect of ours, whose text is the result."""


def _yield_to_others() -> None:
    """Run only when nothing else in the container needs the CPU, above all not the manager.

    A nice value alone leaves the current process its time slice: each wake-up of the manager would wait for it.
    """
    os.nice(_NICENESS)
    if hasattr(os, "SCHED_IDLE"):
        with suppress(OSError):  # a sandbox may forbid it
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def main() -> None:
    """Process jobs until the input ends. The first frame is the limit of CPU time of each job, in seconds."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # the output of a library belongs to the log
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal: the manager ends us
    # Before the first job, so that it is fast.
    import application_manager.core.findings.templatefindings  # noqa: PLC0415
    import application_manager.workers.jobs  # noqa: F401, PLC0415

    _yield_to_others()  # after the imports: on a busy machine, they would take many seconds in the idle class
    questions = sys.stdin.buffer
    limit = _frame(questions)
    if limit is None:
        return
    allowed = float(limit)
    while (frame := _frame(questions)) is not None:
        began = time.process_time()
        signal.setitimer(signal.ITIMER_PROF, allowed)
        answer, well = _answer(frame)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        used = time.process_time() - began if well else FAILED
        answers.write(LENGTH.pack(len(answer)))
        answers.write(struct.pack("<d", used))
        answers.write(answer)
        answers.flush()


def _answer(frame: bytes) -> tuple[bytes, bool]:
    try:
        job: Job[Any] = pickle.loads(frame)  # noqa: S301  from the manager, which started us
        return pickle.dumps(job(), pickle.HIGHEST_PROTOCOL), True
    except MemoryError:  # like CEL in C++: the expression needs more memory than there is
        os.abort()
    except Exception as error:  # noqa: BLE001  a defect in one job must not end the others
        return f"{type(error).__name__}: {error}".encode(), False


def _frame(source: BinaryIO) -> bytes | None:
    head = source.read(LENGTH.size)
    if len(head) < LENGTH.size:
        return None
    (size,) = LENGTH.unpack(head)
    frame = source.read(size)
    return frame if len(frame) == size else None


if __name__ == "__main__":
    main()
