"""Problems of a rule, with their fields."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from wayside.api.documents import FieldPath, field_text


@dataclass(frozen=True, slots=True)
class RuleProblem:
    """A reason why a rule cannot be evaluated: the field, and a message with the remedy."""

    path: FieldPath
    message: str
    detector: str | None = None
    """The Detector that has the field; None: the rule has it."""
    check: str = ""
    """The name of the finding, if it is a warning."""

    def __str__(self) -> str:
        whose = "" if self.detector is None else f"Detector {self.detector}: "
        return f"{whose}{field_text(self.path)}: {self.message}"


class RuleError(Exception):
    """A rule cannot be evaluated; `problems` has every problem."""

    def __init__(self, problems: Iterable[RuleProblem]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(map(str, self.problems)))
