"""Shortens the report of a failing test to the useful lines and the path of the full report."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

MOST = 200
"""Lines of a report, with the headings that pytest adds."""
WIDEST = 1000  # characters of a line
_FRAME = 20  # lines for headings, and for the notes on the lines left out


def shorten(report: pytest.TestReport, folder: Path) -> None:
    """Cut a long report to `MOST` lines; the whole of it goes to a file below `folder`, which the report names.

    The beginning and the end of the failure itself stay, then the end of each section (output, logs).
    """
    failure = report.longreprtext.splitlines()
    sections = [(name, content.splitlines()) for name, content in report.sections]
    if len(failure) + sum(len(lines) + 1 for _, lines in sections) <= MOST - _FRAME:
        return
    folder.mkdir(exist_ok=True, parents=True)
    file = folder / f"{re.sub(r'[^A-Za-z0-9_.]+', '-', report.nodeid)[-150:]}-{report.when}.txt"
    whole = [*failure, *(line for name, lines in sections for line in (f"--- {name}", *lines))]
    file.write_text("\n".join(whole) + "\n", encoding="utf-8")
    room = MOST - _FRAME
    ours = max(room // 2, room - sum(len(lines) + 1 for _, lines in sections))
    if len(failure) > ours:
        failure = [*failure[: ours // 3], f"… {len(failure) - ours} lines …", *failure[-(ours - ours // 3) :]]
    room -= len(failure)
    kept: list[tuple[str, str]] = []
    for left, (name, lines) in zip(range(len(sections), 0, -1), sections, strict=True):
        last = lines[-share:] if (share := max(room // left - 1, 0)) else []
        room -= len(last) + 1
        kept.append((name, "\n".join(map(_narrow, last)) + "\n"))
    report.longrepr = "\n".join([*map(_narrow, failure), f"The whole report: {file}"])
    report.sections = kept


def _narrow(line: str) -> str:
    return line if len(line) <= WIDEST else f"{line[:WIDEST]}… ({len(line)} characters)"
