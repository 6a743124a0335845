"""The manager's side of one worker process: starts it, sends it a job, ends it."""

from __future__ import annotations

import asyncio
import os
import signal
import struct
import sys
from contextlib import suppress

from application_manager.workers.process import LENGTH

_USED = struct.Struct("<d")
_ROOM = 64 * 1024  # bytes that are read ahead


class EndedError(Exception):
    """The process ended during a job; `of_time`: because it used up its CPU time."""

    def __init__(self, why: str, *, of_time: bool) -> None:
        super().__init__(why)
        self.of_time = of_time


class Child:
    """A worker process; it does one job at a time."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process

    @classmethod
    async def start(cls, limit: float) -> Child:
        """Start a process whose jobs have `limit` seconds of CPU time each. It imports its modules in the meantime.

        Raises OSError if no further process can be started.
        """
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "application_manager.workers.process",
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            limit=_ROOM,
            process_group=0,  # a terminal's signals are the manager's; a session would have its own share of the CPU
            env={**os.environ, "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))},
        )
        child = cls(process)
        child._send(repr(limit).encode())
        return child

    async def do(self, job: bytes) -> tuple[bytes, float]:
        """The pickled result of a pickled job, and the seconds of CPU time that it took.

        Raises EndedError if the process ended instead.
        """
        assert self._process.stdin is not None and self._process.stdout is not None  # noqa: S101, PT018  they are pipes
        try:
            self._send(job)
            await self._process.stdin.drain()
            head = await self._process.stdout.readexactly(LENGTH.size + _USED.size)
            (size,), (used,) = LENGTH.unpack(head[: LENGTH.size]), _USED.unpack(head[LENGTH.size :])
            return await self._process.stdout.readexactly(size), used
        except (ConnectionError, asyncio.IncompleteReadError):
            raise await self._ended() from None

    async def close(self) -> None:
        """End the process, whatever its state."""
        if self._process.returncode is None:
            with suppress(ProcessLookupError):
                self._process.kill()
        await self._process.wait()
        if self._process.stdin is not None:
            self._process.stdin.close()

    def _send(self, frame: bytes) -> None:
        assert self._process.stdin is not None  # noqa: S101  it is a pipe
        self._process.stdin.write(LENGTH.pack(len(frame)))
        self._process.stdin.write(frame)

    async def _ended(self) -> EndedError:
        code = await self._process.wait()
        if code == -signal.SIGPROF:
            return EndedError("used up its CPU time", of_time=True)
        why = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"
        return EndedError(why, of_time=False)
