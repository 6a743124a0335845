"""Texts matched against a parameter's pattern, by CEL's regular expressions (RE2): their time is linear in the text.

Pure. Python's own would let a template's pattern and a task's text hold up the manager for as long as they like.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from application_manager.core.claims import values
from wayside.expressions import Environment, Expression, Kind
from wayside.expressions.errors import EvaluationError


def pattern_problem(pattern: str) -> str | None:
    """Why the pattern is none, or None if it is."""
    try:
        _matcher().evaluate({"text": "", "pattern": pattern})
    except EvaluationError as error:
        return f"{values.shown(pattern)} is no regular expression: {error}: correct it (RE2 syntax)"
    return None


def mismatch(pattern: str, value: Any) -> str | None:
    """Why the text, or the array of texts, does not match the pattern; None if it does, or if the pattern is none."""
    if pattern_problem(pattern):
        return None  # the template is told, and not the task
    for index, text in enumerate(value if isinstance(value, list) else [value]):
        # CEL would see only what is before a NUL.
        if "\0" in text or not _matcher().evaluate({"text": text, "pattern": pattern}):
            which = f"item {index}, {values.shown(text)}," if isinstance(value, list) else values.shown(text)
            return f"{which} does not match the pattern {pattern}"
    return None


@lru_cache(maxsize=1)
def _matcher() -> Expression:
    return Environment({"text": Kind.STRING, "pattern": Kind.STRING}).compile("text.matches(pattern)", result=Kind.BOOL)
