"""The output of a failing test is short and names the file with the rest."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.failures import MOST, WIDEST, shorten


def a_report(failure: str, **sections: str) -> pytest.TestReport:
    report = pytest.TestReport("tests/a.py::test_a[x/y]", ("tests/a.py", 1, "test_a"), {}, "failed", failure, "call")
    report.sections = [*sections.items()]
    return report


def lines(report: pytest.TestReport) -> list[str]:
    printed = [report.longreprtext, *(f"{name}\n{content}" for name, content in report.sections)]
    return "\n".join(printed).splitlines()


def numbered(count: int, what: str) -> str:
    return "\n".join(f"{what} {number}" for number in range(count))


@pytest.mark.parametrize(("failure", "output", "logs"), [(9000, 5, 5), (5, 9000, 5), (5, 5, 9000), (300, 300, 300)])
def test_a_long_report_is_cut_and_the_whole_of_it_is_in_the_file_that_it_names(
    tmp_path: Path, failure: int, output: int, logs: int
) -> None:
    sections = {"stdout": numbered(output, "out"), "logs": numbered(logs, "log")}
    report = a_report(numbered(failure, "why"), **sections)
    before = lines(report)
    shorten(report, tmp_path / "failures")
    printed = lines(report)
    assert len(printed) <= MOST
    assert f"why {failure - 1}" in printed, "the end of the failure stays"
    assert {f"out {output - 1}", f"log {logs - 1}"} <= {*printed}, "so does the end of each section"
    (named,) = (re.fullmatch("The whole report: (.+)", line) for line in printed if line.startswith("The whole report"))
    whole = Path(named[1]).read_text(encoding="utf-8").splitlines()
    assert {*before} - {*whole} <= {"stdout", "logs"}


def test_a_short_report_is_left_alone(tmp_path: Path) -> None:
    report = a_report(numbered(50, "why"), stdout=numbered(50, "out"))
    before = lines(report)
    shorten(report, tmp_path / "failures")
    assert lines(report) == before
    assert not (tmp_path / "failures").exists()


def test_a_very_long_line_is_cut_as_well(tmp_path: Path) -> None:
    report = a_report("x" * 100_000 + "\n" + numbered(500, "why"))
    shorten(report, tmp_path)
    assert max(map(len, lines(report))) < WIDEST + 100
