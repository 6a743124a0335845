"""The findings about a template, rule or Detector: errors, errors that may resolve by themselves, and remarks.

The same findings make the condition Accepted, the answer of admission, and what `application-manager check` prints.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from wayside.findings import Finding

_FIELD = re.compile(r"^((?:spec|metadata)\b.*?)(?:, line \d+, column \d+)?: ")


@dataclass(frozen=True, slots=True)
class Findings:
    """Findings whose texts each name the field, the value and the remedy.

    Attributes:
        problems: what is wrong with the object itself, given what is there.
        doubts: why it cannot be used as it is, though another object may put it right: no Detector selects the rule
            yet, or a rule that a signal names is still to come.
        remarks: what may go wrong with an object that is in order: with certain values of tasks, or since a template
            that a rule names is not there.
    """

    problems: tuple[str, ...] = ()
    doubts: tuple[Finding, ...] = ()
    remarks: tuple[Finding, ...] = ()

    @property
    def faults(self) -> tuple[str, ...]:
        """All that keeps the object from being used, each once."""
        return _texts(*self.problems, *self.doubts)

    @property
    def warnings(self) -> tuple[str, ...]:
        """All that is no reason to refuse it, each once."""
        return _texts(*self.doubts, *self.remarks)

    @property
    def all(self) -> tuple[str, ...]:
        """Everything, each once."""
        return _texts(*self.problems, *self.doubts, *self.remarks)


def _texts(*findings: str | Finding) -> tuple[str, ...]:
    return tuple(dict.fromkeys(map(str, findings)))


def field_of(finding: str) -> str:
    """The field that a finding names first, e.g. spec.when; empty where it names none."""
    found = _FIELD.match(finding)
    return found[1] if found else ""
