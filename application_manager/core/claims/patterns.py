"""Texts matched against a parameter's pattern, by CEL's regular expressions (RE2): their time is linear in the text.

Pure. Python's own would let a template's pattern and a task's text hold up the manager for as long as they like.
"""

from __future__ import annotations

import json
from functools import lru_cache
from typing import Any

from application_manager.core.claims import values
from wayside.expressions import CelType, Environment, Expression, ExpressionError
from wayside.expressions.errors import EvaluationError
from wayside.expressions.regex import LARGEST_PATTERN, LONGEST_INPUT, pattern_size

_ENVIRONMENT = Environment({"text": CelType.STRING})


def pattern_problem(pattern: str) -> str | None:
    """Why the pattern is none, or None if it is."""
    if (size := pattern_size(pattern)) > LARGEST_PATTERN:
        return (
            f"{values.shown(pattern)} takes {size} steps, more than {LARGEST_PATTERN}: use fewer repetitions, or "
            "smaller character classes"
        )
    try:
        _matcher(pattern).evaluate({"text": ""})
    except (EvaluationError, ExpressionError) as error:
        return f"{values.shown(pattern)} is not a regular expression: {error.message}: correct it (RE2 syntax)"
    return None


def mismatch(pattern: str, value: Any) -> str | None:
    """Why the text, or the array of texts, does not match the pattern; None if it does, or if the pattern is none."""
    if pattern_problem(pattern):
        return None  # the status of the template reports it, not that of the task
    for index, text in enumerate(value if isinstance(value, list) else [value]):
        which = f"item {index}, {values.shown(text)}," if isinstance(value, list) else values.shown(text)
        if (size := len(text.encode(errors="replace"))) > LONGEST_INPUT:
            return f"{which} has {size} bytes: a pattern can match at most {LONGEST_INPUT}"
        # CEL would see only what is before a NUL.
        if "\0" in text or not _matcher(pattern).evaluate({"text": text}):
            return f"{which} does not match the pattern {pattern}"
    return None


@lru_cache(maxsize=256)
def _matcher(pattern: str) -> Expression:
    literal = json.dumps(pattern, ensure_ascii=False)
    return _ENVIRONMENT.compile(f"text.matches({literal})", result=CelType.BOOL)
