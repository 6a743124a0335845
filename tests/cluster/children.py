"""Child processes, each with a log, which end with the test run at the latest.

Every child has a session of its own, so a Ctrl-C in the terminal reaches only the test run, which then stops its
children in the right order; should the test run itself be killed, the reaper kills them.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO

from tests.patience import PATIENCE
from tests.programs import PROGRAMS, Program

_register_lock = threading.Lock()
_reaper: subprocess.Popen[str] | None = None


GRACE = 30
"""Seconds that Kubernetes gives a pod to end, by default."""


class Child:
    """One process, from its start to its end; stdout and stderr are appended to `log`."""

    def __init__(self, name: str, command: Sequence[str], log: Path, environment: Mapping[str, str] | None = None):
        """Start `command` with exactly this `environment` (default: that of the test run).

        A command that begins with the bare name of one of our programs is forked (see `tests.programs`).
        """
        self.name = name
        self.log = log
        self._process: Program | subprocess.Popen[bytes]
        if command[0] in PROGRAMS:
            self._process = Program(command, log, environment=environment)
        else:
            with log.open("ab") as output:
                self._process = subprocess.Popen(
                    list(command),
                    env=environment,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    process_group=0,
                )
        _register(f"+{self.pid}")

    @property
    def pid(self) -> int:
        """The process id, which is that of its process group too."""
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        """The exit code, negative for a signal; None while it runs."""
        return self._process.poll()

    @property
    def alive(self) -> bool:
        """Whether it still runs."""
        return self.returncode is None

    def signal(self, number: int) -> None:
        """Send a signal to the process itself, not to its children; does nothing if it has ended."""
        self._process.send_signal(number)

    def wait(self, timeout: float) -> int:
        """Wait for its end and return the exit code.

        Raises:
            TimeoutError: it still runs after `timeout` seconds; the message has the end of its log.
        """
        try:
            code = self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            raise TimeoutError(f"{self.name} (pid {self.pid}) still runs after {timeout:g} s\n{self.tail()}") from None
        self._kill_group()
        return code

    def terminate(self, patience: float = PATIENCE) -> int:
        """Send SIGTERM and wait for the end; return the exit code.

        Raises:
            TimeoutError: it still ran after `patience` seconds. It is then killed: not stopping is a defect in itself.
        """
        self.signal(signal.SIGTERM)
        try:
            return self.wait(patience)
        except TimeoutError:
            self.kill9()
            raise

    def kill9(self) -> None:
        """Send SIGKILL to the whole process group, as a crash of its container would, and wait for the end."""
        self._kill_group()
        self._process.kill()  # the group may be missing: a process that was just forked is still in its parent's group
        self._process.wait()

    def resident_bytes(self) -> int:
        """Return the memory it holds now; 0 if the system does not report it (only Linux does)."""
        try:
            status = Path(f"/proc/{self.pid}/status").read_text()
        except OSError:
            return 0
        found = re.search(r"^VmRSS:\s+(\d+) kB", status, re.MULTILINE)
        return int(found[1]) * 1024 if found else 0

    def tail(self, lines: int = 40) -> str:
        """Return the last lines of the log under a heading, for messages."""
        state = "running" if self.alive else f"exit code {self.returncode}"
        return f"--- {self.name}: {state}\n{log_tail(self.log, lines)}"

    def _kill_group(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        _register(f"-{self.pid}")


def log_tail(log: Path, lines: int = 40) -> str:
    """Return the last lines of a log under a heading, for messages."""
    text = log.read_text(errors="replace").splitlines()[-lines:] if log.exists() else []
    return "\n".join([f"--- end of {log}", *(text or ["(empty)"])])


def remove_afterwards(folder: Path) -> None:
    """Remove the folder when the test run ends, even if it is killed."""
    _register(str(folder.absolute()))


def _register(message: str) -> None:
    global _reaper  # noqa: PLW0603  one reaper for all children of this process
    with _register_lock:
        if _reaper is None:
            command = [sys.executable, "-I", "-S", str(Path(__file__).with_name("reaper.py"))]
            _reaper = subprocess.Popen(command, stdin=subprocess.PIPE, text=True, start_new_session=True)
        pipe: IO[str] | None = _reaper.stdin
        assert pipe is not None
        pipe.write(message + "\n")
        pipe.flush()
