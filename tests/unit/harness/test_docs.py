"""Pages in docs/ agree with the code and with each other."""

from __future__ import annotations

import re

from application_manager.core.findings import checks as manager_checks
from detector import findings as detector_checks
from tests.guides import ROOT, guide

DECISIONS = ROOT / "docs/decisions"
STATUS = re.compile(r"(?:Accepted|Superseded by \[\d+\]\(\d{4}-[a-z0-9-]+\.md\)), \d{4}-\d\d-\d\d")
LINK = re.compile(r"\]\((?!https?:)([^)#\s]+)")


def test_decisions_are_numbered_without_gaps_and_the_index_lists_each_with_its_status() -> None:
    files = sorted(DECISIONS.glob("[0-9]*.md"))
    assert [int(each.name[:4]) for each in files] == list(range(1, len(files) + 1))
    rows = []
    for number, file in enumerate(files, 1):
        heading, _, status, *_ = file.read_text(encoding="utf-8").splitlines()
        title = heading.removeprefix(f"# {number}. ")
        assert title != heading, f"{file.name}: the heading is not '# {number}. <title>'"
        assert STATUS.fullmatch(status.removeprefix("Status: ")), f"{file.name}: no status in line 3"
        rows.append(f"| [{number}]({file.name}) | {title} | {status.removeprefix('Status: ')} |")
    index = (DECISIONS / "README.md").read_text(encoding="utf-8").splitlines()
    assert [line for line in index if line.startswith("| [")] == rows


def test_links_between_pages_lead_to_files() -> None:
    pages = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]
    dead = [
        f"{page.name}: {to}"
        for page in pages
        for to in LINK.findall(page.read_text(encoding="utf-8"))
        if not (page.parent / to).exists()
    ]
    assert not dead


def test_findings_are_documented_with_their_severities() -> None:
    for command, checks in (
        ("detector check", detector_checks.CHECKS),
        ("application-manager check", manager_checks.CHECKS),
    ):
        rows = [f"| `{each.name}` | {each.severity} | {each.meaning} |" for each in checks]
        section = guide("findings").partition(f"\n## `{command}`\n")[2].partition("\n## ")[0]
        assert [line for line in section.splitlines() if line.startswith("| `")] == rows
        assert len({each.name for each in checks}) == len(checks)
