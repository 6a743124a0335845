"""`python -m tests.prose`: keeps retired phrases out of the places listed here, and misspelt words out of the tree.

A retired phrase stands for a standard term of the field. The check prints `file:line: phrase: suggestion` for each, and
ends with exit code 1 if there is any. codespell finds misspelt words; its settings are in pyproject.toml.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]

CLEAN = (
    "CONTRIBUTING.md",
    "application_manager",
    "charts/wayside/files/crds",
    "crds",
    "detector",
    "docs/actions.md",
    "docs/buffer.md",
    "docs/classification.md",
    "docs/concepts.md",
    "docs/database.md",
    "docs/decisions",
    "docs/encodings.md",
    "docs/etsi.md",
    "docs/evaluation.md",
    "docs/findings.md",
    "docs/models.md",
    "docs/notify.md",
    "docs/placement.md",
    "docs/plugins.md",
    "docs/recording.md",
    "docs/regions.md",
    "docs/rules.md",
    "docs/scale.md",
    "docs/scopes.md",
    "docs/templates.md",
    "docs/trigger.md",
    "docs/troubleshooting.md",
    "wayside",
)
"""Files, and folders with all files below them, as git lists them. A new place is added once it is clean."""

RETIRED = {
    r"told": "reported, published, receives",
    r"(?<!\.)tells?": "reports, names, distinguishes, explains",
    r"said": "reported, logged, published",
    r"says?": "reports, contains, defines, names; such as",
    r"asks|asked": "requests, queries, uses",
    r"bears?|borne": "carries, has, tolerates",
    r"anew": "again; restarts, is replaced",
    r"so (many|much|long|often)": "the number of, the maximum, at most, for this time",
    r"whoever|whom": "name the subject",
    r"lacking": "missing",
    r"taken for": "treated as",
    r"made up for": "skipped",
    r"(takes?|took|taken) up": "restores, continues",
    r"(goes|go|went|going) on": "continues",
    r"employed": "used",
    r"news": "event, change",
    r"book": "index, cache",
}
"""Regular expressions of phrases, and the terms to use instead."""

_PHRASES = re.compile("|".join(rf"(?P<p{n}>\b(?:{each})\b)" for n, each in enumerate(RETIRED)), re.IGNORECASE)


def findings(text: str) -> Iterator[tuple[int, str, str]]:
    """The line, the phrase and the suggestion of each retired phrase in a text."""
    suggestions = list(RETIRED.values())
    for number, line in enumerate(text.splitlines(), start=1):
        for match in _PHRASES.finditer(line):
            yield number, match[0], suggestions[int(str(match.lastgroup)[1:])]


def _files() -> list[str]:
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "--", *CLEAN],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    return sorted(name for name in set(listed.stdout.splitlines()) if (ROOT / name).is_file())


def main() -> int:
    """Print every finding; the exit code."""
    found = 0
    for name in _files():
        for line, phrase, suggestion in findings((ROOT / name).read_text(encoding="utf-8")):
            print(f"{name}:{line}: {phrase!r} is retired: {suggestion}")
            found += 1
    misspelt = subprocess.run([sys.executable, "-m", "codespell_lib", "."], cwd=ROOT, check=False).returncode
    return 1 if found or misspelt else 0


if __name__ == "__main__":
    sys.exit(main())
