"""Normalises the output of a run, so that another run prints the same: random names, times and ages.

Names keep their look and their length; a time becomes the minute of the step in which it was first seen.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections import Counter

_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d+)?Z")
_POD = re.compile(r"(scene-[a-z]+-[a-z2-7]{10})-[a-z0-9]{6,10}-[a-z0-9]{5}\b")
_LEASE_AGE = re.compile(r"its Lease was renewed -?[\d.]+ s ago")
_TABLE = re.compile(r"^NAME {2,}[A-Z].*\n(?:.+\n)*", re.MULTILINE)
_AGE = "1m"


class Uniform:
    """Replaces what differs from run to run; the same thing is always replaced by the same."""

    def __init__(self, namespace: str) -> None:
        """`namespace`: the run's, which is called town."""
        self._namespace = namespace
        self._names: dict[str, str] = {}
        self._pods: dict[str, str] = {}
        self._counts: Counter[str] = Counter()
        self._times: dict[str, str] = {}
        self.step = 0
        """The minute that times which are new get."""

    def name_task(self, name: str, about: str) -> None:
        """Know a task by what it is about; of several alike, by their order."""
        if name not in self._names:
            self._names[name] = f"{name[:-16]}{self._letters(about, 16)}"

    def note_time(self, time: str, seconds: int = 0) -> None:
        """Know a time as one of this step, `seconds` after the start of its minute."""
        self._times.setdefault(time, f"2026-05-04T10:{self.step:02}:{seconds:02}Z")

    def text(self, text: str) -> str:
        """The output of a command."""
        for real, uniform in self._names.items():
            text = text.replace(real, uniform)
        text = _POD.sub(self._pod, text)
        text = _LEASE_AGE.sub("its Lease was renewed 1 s ago", text)
        text = _TIME.sub(self._time, text)
        text = text.replace(f"in {self._namespace} namespace", "in town namespace")
        return _TABLE.sub(lambda found: _table(found[0]), text)

    def _pod(self, found: re.Match[str]) -> str:
        if found[0] not in self._pods:
            letters = self._letters(found[1], 15)
            self._pods[found[0]] = f"{found[1]}-{letters[:10]}-{letters[10:]}"
        return self._pods[found[0]]

    def _time(self, found: re.Match[str]) -> str:
        self.note_time(found[0])
        return self._times[found[0]]

    def _letters(self, about: str, count: int) -> str:
        self._counts[about] += 1
        digest = hashlib.sha256(f"{about} {self._counts[about]}".encode()).digest()
        return base64.b32encode(digest).decode().lower()[:count]


def _table(text: str) -> str:
    """A table of kubectl with uniform ages, its rows in order and its columns as wide as they must be."""
    header, *rows = text.splitlines()
    starts = [found.start() for found in re.finditer(r"(?<!\S)\S+", header)]
    headings = [header[start:].split()[0] for start in starts]
    ends = [*starts[1:], None]
    cells: list[list[str]] = [[row[start:end].strip() for start, end in zip(starts, ends, strict=True)] for row in rows]
    for row in cells:
        for index, heading in enumerate(headings):
            if heading == "AGE":
                row[index] = _AGE
    lines = [headings, *sorted(cells)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    padded = [
        "   ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
    ]
    return "\n".join(padded) + "\n"
