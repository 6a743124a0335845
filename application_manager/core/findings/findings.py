"""The findings about a template, rule or Detector: errors, errors that may resolve by themselves, and remarks.

The condition Accepted, the webhook's response and the output of `application-manager check` contain the same findings.
"""

from __future__ import annotations

import re
from collections.abc import Set
from dataclasses import dataclass

from wayside.findings import Finding

_FIELD = re.compile(r"^((?:spec|metadata)\b.*?)(?:, line \d+, column \d+)?: ")


@dataclass(frozen=True, slots=True)
class Findings:
    """Findings whose texts each name the field, the value and the remedy.

    Attributes:
        problems: errors of the object itself.
        doubts: why it cannot be used now, although another object may correct that: no Detector selects the rule yet,
            or a rule that a signal names does not exist yet.
        remarks: what may fail although the object is valid: with certain values of tasks, or because a template that a
            rule names does not exist.
    """

    problems: tuple[str, ...] = ()
    doubts: tuple[Finding, ...] = ()
    remarks: tuple[Finding, ...] = ()

    @property
    def faults(self) -> tuple[str, ...]:
        """All findings that prevent the use of the object, each once."""
        return _texts(*self.problems, *self.doubts)

    def warnings(self, ignored: Set[str]) -> tuple[str, ...]:
        """All findings that are no reason to refuse the object, each once, with their names.

        `ignored`: the names of those to leave out.
        """
        found = (each for each in (*self.doubts, *self.remarks) if each.check not in ignored)
        return _texts(*(f"{each} [{each.check}]" for each in found))


def _texts(*findings: str | Finding) -> tuple[str, ...]:
    return tuple(dict.fromkeys(map(str, findings)))


def field_of(finding: str) -> str:
    """The field that a finding names first, e.g. spec.when; empty if it names none."""
    found = _FIELD.match(finding)
    return found[1] if found else ""
