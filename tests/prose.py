"""`python -m tests.prose`: keeps retired phrases and misspelt words out of the tree.

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

EXCEPT = ("LICENSE", "tests/prose.py")
"""A file by other authors, and this one, which lists the phrases."""

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
_JOINED = re.compile(r"(?<=[^\W_])_(?=[^\W_])")  # in identifiers: the words of a test's name are read as a text


def findings(text: str) -> Iterator[tuple[int, str, str]]:
    """The line, the phrase and the suggestion of each retired phrase in a text."""
    suggestions = list(RETIRED.values())
    for number, line in enumerate(text.splitlines(), start=1):
        for match in _PHRASES.finditer(_JOINED.sub(" ", line)):
            yield number, match[0], suggestions[int(str(match.lastgroup)[1:])]


def _texts() -> Iterator[tuple[str, str]]:
    """The name and the text of each file that git lists; binary files are left out."""
    skipped = [f":(exclude){place}" for place in EXCEPT]
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "--", ".", *skipped],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    for name in sorted(set(listed.stdout.splitlines())):
        content = (ROOT / name).read_bytes() if (ROOT / name).is_file() else b""
        if b"\0" not in content:
            yield name, content.decode()


def main() -> int:
    """Print every finding; the exit code."""
    found = 0
    for name, text in _texts():
        for line, phrase, suggestion in findings(text):
            print(f"{name}:{line}: {phrase!r} is retired: {suggestion}")
            found += 1
    misspelt = subprocess.run([sys.executable, "-m", "codespell_lib", "."], cwd=ROOT, check=False).returncode
    return 1 if found or misspelt else 0


if __name__ == "__main__":
    sys.exit(main())
