"""Wayside's programs as processes that start fast: forked from a process that has already imported them.

Importing what a program needs takes one to two seconds of CPU, and hundreds of tests start one. So each worker of a
test run has a fork server (Python's own, of `multiprocessing`) that imports both programs once. What it forks is a
process like any other, with its own environment, folder, signals and output; only the imports are shared. A test that
is about the start itself runs the console script (`script`).
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal

from tests.patience import PATIENCE

Name = Literal["detector", "application-manager"]
PROGRAMS: Mapping[str, str] = {
    "detector": "detector.commands.program",
    "application-manager": "application_manager.program",
}
"""The module of each program; its `main` reads `sys.argv`."""
BIN = Path(sys.executable).parent

_servers = multiprocessing.get_context("forkserver")
_servers.set_forkserver_preload(["tests.preloaded"])


def script(name: Name) -> str:
    """The path of the console script, for tests about starting."""
    return str(BIN / name)


class Program:
    """One run of a program, from its start to its end; the leader of its own session and process group."""

    def __init__(
        self,
        arguments: Sequence[str],
        output: Path,
        *,
        errors: Path | None = None,
        environment: Mapping[str, str] | None = None,
        folder: Path | None = None,
    ) -> None:
        """Start it.

        Args:
            arguments: the program's name and its arguments.
            output: the file that stdout is appended to.
            errors: the same for stderr; by default it joins stdout.
            environment: all of its environment; by default that of the test run.
            folder: its working directory; by default that of the test run.
        """
        self.arguments = [str(each) for each in arguments]
        files = (output.absolute(), (errors or output).absolute())
        for file in files:
            file.touch()  # the file exists for an immediate reader
        everything = dict(os.environ if environment is None else environment)
        where = str(folder or Path.cwd())
        # A daemon of `multiprocessing` is one that is terminated at the end of the test run, not waited for.
        self._process = _servers.Process(target=_become, args=(self.arguments, files, everything, where), daemon=True)
        self._process.start()

    @property
    def pid(self) -> int:
        """The process id."""
        assert self._process.pid is not None
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        """The exit code, negative for a signal; None while it runs."""
        return self._process.exitcode

    def poll(self) -> int | None:
        """Return the exit code; None while it runs."""
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end and return the exit code. Raises subprocess.TimeoutExpired."""
        self._process.join(timeout)
        code = self.returncode
        if code is None:
            assert timeout is not None
            raise subprocess.TimeoutExpired(self.arguments, timeout)
        return code

    def send_signal(self, number: int) -> None:
        """Send a signal; nothing happens if it has ended."""
        if self.returncode is None:
            with suppress(ProcessLookupError):  # it has ended, but its exit code is not known yet
                os.kill(self.pid, number)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)


def run(
    *arguments: str | Path,
    environment: Mapping[str, str] | None = None,
    folder: Path | None = None,
    check: bool = False,
    timeout: float = PATIENCE,
) -> subprocess.CompletedProcess[str]:
    """Run a program to its end; return its exit code and what it wrote.

    Args:
        arguments: the program's name and its arguments.
        environment: variables in addition to those of the test run.
        folder: its working directory.
        check: raise subprocess.CalledProcessError where the exit code is not 0.
        timeout: seconds, after which it is killed and subprocess.TimeoutExpired raised.
    """
    command = [str(each) for each in arguments]
    with tempfile.TemporaryDirectory(prefix="wayside-run-") as temporary:
        output, errors = Path(temporary) / "stdout", Path(temporary) / "stderr"
        everything = os.environ | dict(environment or {})
        program = Program(command, output, errors=errors, environment=everything, folder=folder)
        try:
            code = program.wait(timeout)
        finally:
            program.kill()
        done = subprocess.CompletedProcess(command, code, output.read_text("utf-8"), errors.read_text("utf-8"))
    if check and code:
        raise AssertionError(f"{' '.join(command)}: exit code {code}\n{done.stderr}")
    return done


def _become(arguments: list[str], files: tuple[Path, Path], environment: dict[str, str], folder: str) -> None:
    """Run as the program, in a process that was just forked."""
    from importlib import import_module

    os.setsid()
    for stream, path in zip((1, 2), files, strict=True):
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        os.dup2(file, stream)
        os.close(file)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    given = filter(None, environment.get("PYTHONPATH", "").split(os.pathsep))
    sys.path[1:1] = given
    sys.path[0] = str(BIN)
    sys.argv = [str(BIN / arguments[0]), *arguments[1:]]
    for output in (sys.stdout, sys.stderr):
        output.reconfigure(line_buffering=True, encoding="utf-8")  # type: ignore[union-attr]
    import_module(PROGRAMS[arguments[0]]).main()
