"""`python -m tests.prose`: keeps retired phrases, retired names and misspelt words out of the tree.

A standard term of the field replaces each retired phrase and name. Phrases are searched in all text, where an
identifier reads as its words; names only in the identifiers of Python files. The check prints
`file:line: phrase: suggestion` for each finding and exits with code 1 if there is any. codespell finds misspelt words;
its settings are in pyproject.toml.
"""

from __future__ import annotations

import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]

EXCEPT = ("LICENSE", "tests/prose.py", "tests/unit/harness/test_prose.py")
"""A file by other authors, and the list of the phrases with its test."""

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

RETIRED_NAMES = {
    "aspect": "name the part",
    "courier": "publisher, sender",
    "deed": "action, outcome",
    "desk": "server, handler",
    "inflow": "intake, input",
    "onlooker": "observer",
    "outlet": "publisher, sender",
    "sight": "view, visibility",
    "standing": "status, condition; stationary",
    "tally": "counters, total",
    "world": "cache, cluster",
}
"""Words that no identifier contains, in the singular or plural, and the terms to use instead."""

_PHRASES = re.compile("|".join(rf"(?P<p{n}>\b(?:{each})\b)" for n, each in enumerate(RETIRED)), re.IGNORECASE)
_BETWEEN_WORDS = re.compile(r"(?<=[^\W_])_(?=[^\W_])|(?<=[a-z])(?=[A-Z])")
_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")


def findings(text: str) -> Iterator[tuple[int, str, str]]:
    """The line, the phrase and the suggestion of each retired phrase in a text."""
    suggestions = list(RETIRED.values())
    for number, line in enumerate(text.splitlines(), start=1):
        for match in _PHRASES.finditer(_BETWEEN_WORDS.sub(" ", line)):
            yield number, match[0], suggestions[int(str(match.lastgroup)[1:])]


def name_findings(source: str) -> Iterator[tuple[int, str, str]]:
    """The line, the identifier and the suggestion of each retired name in Python source."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.NAME:
            for word in _WORD.findall(token.string):
                singular = re.sub("ies$", "y", word.lower()).removesuffix("s")
                if singular in RETIRED_NAMES:
                    yield token.start[0], token.string, RETIRED_NAMES[singular]


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
        for line, phrase, suggestion in [*findings(text), *(name_findings(text) if name.endswith(".py") else ())]:
            print(f"{name}:{line}: {phrase!r} is retired: {suggestion}")
            found += 1
    misspelt = subprocess.run([sys.executable, "-m", "codespell_lib", "."], cwd=ROOT, check=False).returncode
    return 1 if found or misspelt else 0


if __name__ == "__main__":
    sys.exit(main())
