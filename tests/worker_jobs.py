"""Jobs for worker processes with few imports; they do what a template's expression could do."""

from __future__ import annotations

import os
import random
import signal
from dataclasses import dataclass
from pathlib import Path

from wayside.expressions import CelType, Environment

BOMB = 'l.filter(x, s.matches("([ab]*a[ab]{50}){3}z")).size()'
"""Takes about 15 ms for each item of `l` if `s` has 4 KiB, in C++, while it holds the GIL."""

TEXT = "".join(random.Random(1).choices("ab", k=4000))  # without a pattern, so that RE2 remembers nothing


@dataclass(frozen=True)
class Evaluation:
    """The bomb, on `items` items."""

    items: int

    def __call__(self) -> object:
        """The number of items that match."""
        expression = Environment({"l": CelType.LIST, "s": CelType.STRING}).compile(BOMB)
        return expression.evaluate({"l": [0.0] * self.items, "s": TEXT})


@dataclass(frozen=True)
class Scheduled:
    """When its process runs."""

    def __call__(self) -> int:
        """The scheduling class."""
        return os.sched_getscheduler(0)


@dataclass(frozen=True)
class Where:
    """Which process it is."""

    def __call__(self) -> int:
        """The process id."""
        return os.getpid()


@dataclass(frozen=True)
class KilledOnce:
    """Is killed from outside at the first attempt, as by a node that lacks memory."""

    marker: Path

    def __call__(self) -> str:
        """The result of the attempt that was not killed."""
        if not self.marker.exists():
            self.marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return "done"


@dataclass(frozen=True)
class Greedy:
    """Takes more memory than a process may have."""

    def __call__(self) -> int:
        """Never returns."""
        return len(b" " * (2 * 1024**3))


@dataclass(frozen=True)
class Defective:
    """Raises an exception that no job should raise."""

    def __call__(self) -> object:
        """Nothing."""
        raise RuntimeError("a defect")
