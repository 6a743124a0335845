"""Wayside's own programs as processes of a test: started, killed and restarted, each with a log."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path

from tests.cluster.children import Child
from tests.cluster.waiting import wait_until
from tests.patience import PATIENCE
from tests.programs import BIN, PROGRAMS

SCHEDULING = Path(__file__).with_name("scheduling")
"""On Python's path it leaves worker processes out of the idle class."""


def environment_of(kubeconfig: Path) -> dict[str, str]:
    """The environment of the programs of a test: the kubeconfig, and worker processes that share the CPU."""
    path = (str(SCHEDULING), os.environ.get("PYTHONPATH"))
    return {"KUBECONFIG": str(kubeconfig), "PYTHONPATH": os.pathsep.join(filter(None, path))}


class Process:
    """One program through all its restarts, which share one log with a separating line.

    Attributes:
        name: unique in the test, names the log.
        log: of stdout and stderr.
    """

    def __init__(self, name: str, command: list[str], log: Path, environment: Mapping[str, str]):
        """Start it."""
        self.name = name
        self.log = log
        self.starts = 0
        self._command = command
        self._environment = environment
        self._seen_from = 0
        self._child = self._start()

    @property
    def pid(self) -> int:
        """The process id of the current run."""
        return self._child.pid

    @property
    def alive(self) -> bool:
        """Whether the current run is alive."""
        return self._child.alive

    @property
    def returncode(self) -> int | None:
        """The exit code of the current run, negative for a signal; None while it is alive."""
        return self._child.returncode

    def resident_bytes(self) -> int:
        """The memory that the current run uses; 0 if the system does not report it."""
        return self._child.resident_bytes()

    def terminate(self, patience: float = PATIENCE) -> int:
        """Send SIGTERM, wait for the end, return the exit code; TimeoutError (and SIGKILL) after `patience` seconds."""
        return self._child.terminate(patience)

    def kill9(self) -> None:
        """Send SIGKILL to it and to all its children."""
        self._child.kill9()

    def wait(self, timeout: float = PATIENCE) -> int:
        """Wait until it ends by itself and return the exit code; TimeoutError with its log after `timeout` seconds."""
        return self._child.wait(timeout)

    def start(self) -> None:
        """Start it again, with the same command line and environment; it must have ended."""
        assert not self.alive, f"{self.name} still runs (pid {self.pid}): terminate() or kill9() it first"
        self._child = self._start()

    def restart(self) -> None:
        """End it by SIGTERM and start it again."""
        self.terminate()
        self.start()

    def output(self) -> str:
        """Return the output of the current run."""
        with self.log.open("rb") as log:
            log.seek(self._seen_from)
            return log.read().decode(errors="replace")

    def wait_for_output(self, pattern: str, timeout: float = PATIENCE) -> re.Match[str]:
        """Wait until the output of the current run matches; return the match.

        Raises:
            TimeoutError: no match after `timeout` seconds; with the end of the log.
            ChildProcessError: the program ended without a match.
        """

        def look() -> re.Match[str] | None:
            alive = self.alive  # before the output is read, so that its last output counts
            found = re.search(pattern, self.output(), re.MULTILINE)
            if found is None and not alive:
                raise ChildProcessError(f"{self.name} ended without writing {pattern!r}\n{self._child.tail()}")
            return found

        what = f"{self.name} writes {pattern!r}"
        found = wait_until(look, lambda found: found is not None, timeout=timeout, what=what, diagnose=self._child.tail)
        assert found is not None
        return found

    def tail(self, lines: int = 40) -> str:
        """Return the last lines of the log under a heading, for messages."""
        return self._child.tail(lines)

    def _start(self) -> Child:
        self.starts += 1
        with self.log.open("a") as log:
            log.write(f"=== start {self.starts}: {' '.join(self._command)}\n")
        self._seen_from = self.log.stat().st_size
        return Child(self.name, self._command, self.log, self._environment)


class Processes:
    """All programs of one test."""

    def __init__(self, folder: Path, environment: Mapping[str, str]):
        """Start none yet. Logs are in `folder`; every program has `environment` in addition to that of the test run."""
        self.folder = folder
        self.environment = dict(environment)
        self._all: dict[str, Process] = {}

    def start(self, *command: str, name: str = "", environment: Mapping[str, str] | None = None) -> Process:
        """Start a program, e.g. `start("application-manager", "run", "--namespace", namespace)`.

        Args:
            command: a console script of this project, or any program on PATH, and its arguments.
            name: for the log and for messages; default: the program's, numbered if there are several.
            environment: additional variables of this program.
        """
        name = name or self._free_name(command[0])
        if name in self._all:
            raise ValueError(f"a process {name!r} already exists: give another name, or restart that one")
        script = BIN / command[0]
        argv = [str(script) if script.exists() and command[0] not in PROGRAMS else command[0], *command[1:]]
        # A program's output must not stay in a buffer while a test waits for it.
        everything = os.environ | {"PYTHONUNBUFFERED": "1"} | self.environment | dict(environment or {})
        process = Process(name, argv, self.folder / f"{name}.log", everything)
        self._all[name] = process
        return process

    def tails(self, lines: int = 60) -> str:
        """Return the ends of all logs."""
        return "\n".join(process.tail(lines) for process in self._all.values())

    def kill_all(self) -> None:
        """Kill all programs that still run."""
        for process in self._all.values():
            process.kill9()

    def _free_name(self, program: str) -> str:
        base = Path(program).name
        taken = sum(1 for name in self._all if name == base or re.fullmatch(rf"{re.escape(base)}-\d+", name))
        return f"{base}-{taken + 1}" if taken else base
