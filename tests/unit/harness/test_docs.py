"""Pages in docs/ agree with the code and with each other."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

from application_manager.core.findings import checks as manager_checks
from detector.findings import checks as detector_checks
from tests.guides import ROOT, guide

TROUBLES = guide("troubleshooting")
DECISIONS = ROOT / "docs/decisions"
STATUS = re.compile(r"(?:Accepted|Superseded by \[[\w.]+\]\([\w./-]+\.md\)), \d{4}-\d\d-\d\d")
MODULE = re.compile(r"(?<![\w/])(?:\w+/)*\w+\.py\b|(?<=`)(?:\w+/)+(?=`)")
PACKAGES = [
    ROOT / each
    for each in ("", "wayside", "detector", "detector/engine", "application_manager", "application_manager/core")
]
LINK = re.compile(r"\]\((?!https?:)([^)#\s<]+)[)#]")


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


def test_files_that_contributing_names_exist() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = re.findall(r"`((?:wayside|detector|application_manager|tests|docs|crds|benchmarks)/[\w./]*)`", text)
    assert len(named) > 20
    assert [each for each in named if not (ROOT / each).exists()] == []


def test_modules_and_folders_that_architecture_engine_and_decisions_name_exist() -> None:
    pages = [ROOT / "docs/architecture.md", ROOT / "docs/engine.md", *DECISIONS.glob("[0-9]*.md")]
    texts = {page.name: page.read_text(encoding="utf-8") for page in pages}
    current = {name: text for name, text in texts.items() if "\nStatus: Superseded" not in text}
    named = {(name, path) for name, text in current.items() for path in MODULE.findall(text)}
    assert len(named) > 80
    assert [each for each in named if not any((folder / each[1]).exists() for folder in PACKAGES)] == []


def test_quotes_in_troubleshooting_occur_in_the_code() -> None:
    """A quoted word is a whole string or a member of an enum; a quote with spaces or … is a part of one string."""
    strings = set(_strings())
    quotes = [
        quote
        for row in re.findall(r"^\| (?!you see)(.*?) \| ", TROUBLES, re.MULTILINE)
        for quote in re.findall(r"`([^`]+)`", row)
    ]
    assert len(quotes) > 60
    unknown = [quote for quote in quotes if not _occurs(quote, strings)]
    assert not unknown


def test_each_symptom_of_troubleshooting_has_commands_and_remedies_and_is_listed() -> None:
    listed = re.findall(r"\[([^]]+)\]\(#([a-z-]+)\)", TROUBLES.partition("\n## ")[0])
    sections = TROUBLES.split("\n## ")[1:]
    assert [name for name, _ in listed] == [section.partition("\n")[0] for section in sections]
    assert all(anchor == name.lower().replace(" ", "-") for name, anchor in listed)
    for section in sections:
        assert "```console\n$ " in section, section
        assert "\n| you see | it means | do |\n" in section, section


def _occurs(quote: str, strings: set[str]) -> bool:
    if " " not in quote and "…" not in quote:
        return quote.removesuffix("_total") in strings
    parts = [part.strip() for part in quote.split("…")]
    return any(all(part in each for part in parts) for each in strings)


def _strings() -> Iterator[str]:
    """All strings of the programs, with … for each value that an f-string inserts, and the members of all enums."""
    for file in (
        file for each in ("detector", "application_manager", "wayside") for file in (ROOT / each).rglob("*.py")
    ):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            match node:
                case ast.Constant(value=str(text)):
                    yield text
                case ast.JoinedStr(values=values):
                    yield "".join(str(each.value) if isinstance(each, ast.Constant) else "…" for each in values)
                case ast.ClassDef(body=body):
                    for each in body:
                        if isinstance(each, ast.Assign) and isinstance(each.targets[0], ast.Name):
                            yield each.targets[0].id.lower()
