"""Findings of the check commands: each has a stable name, by which it is listed and ignored, and a severity. Pure."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum

from wayside.inputerror import InputError

IGNORE_ANNOTATION = "wayside.dev/ignore-findings"
"""The annotation of an object with the names of the warnings about it that are not reported, separated by commas."""


class Severity(StrEnum):
    """Whether a finding makes the check fail."""

    ERROR = "error"
    WARNING = "warning"


@dataclass(frozen=True, slots=True)
class Check:
    """One kind of finding.

    Attributes:
        name: words in lower case, joined by hyphens; it never changes.
        severity: errors fail the check; warnings fail it only with `--strict`, and can be ignored.
        meaning: the condition under which it is reported, without a full stop.
    """

    name: str
    severity: Severity
    meaning: str


@dataclass(frozen=True, slots=True)
class Finding:
    """A finding without a position in a file.

    Attributes:
        check: the name of its check.
        text: the problem, its place and the remedy.
        rule: the EventRule that it is about; empty if it is only about the Detector.
    """

    check: str
    text: str
    rule: str = ""

    def __str__(self) -> str:
        return self.text

    def as_warning(self) -> str:
        """The text of a warning."""
        return f"warning: {self.text}"


UNREADABLE_FILE = Check("unreadable-file", Severity.ERROR, "a file is not YAML, or an object does not fit its kind")
INVALID_DETECTOR = Check("invalid-detector", Severity.ERROR, "a field of a Detector cannot be used")


def ignorable(names: Iterable[str], checks: Iterable[Check]) -> frozenset[str]:
    """The names, if all of them are names of warnings.

    Raises InputError for a name that no check has, and for the name of an error.
    """
    known = {each.name: each.severity for each in checks}
    given = frozenset(names)
    for name in sorted(given):
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            remedy = f"did you mean {close[0]}?" if close else "--list prints all names"
            raise InputError(f"--ignore {name}: there is no such finding; {remedy}")
        if known[name] is Severity.ERROR:
            raise InputError(f"--ignore {name}: this is an error, and only warnings can be ignored; correct the file")
    return given


def ignored_by(annotations: Mapping[str, str]) -> frozenset[str]:
    """The names in an object's annotation."""
    return frozenset(each.strip() for each in annotations.get(IGNORE_ANNOTATION, "").split(","))


def check_lines(checks: Iterable[Check]) -> Iterator[str]:
    """A line for each check: its name, severity and meaning, separated by tabs."""
    return (f"{each.name}\t{each.severity}\t{each.meaning}" for each in checks)
