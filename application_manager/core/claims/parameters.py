"""Checks the parameters of tasks against those that the template declares. Pure.

A task with an invalid value is refused as a whole, and contributes nothing. Patterns are matched by CEL's regular
expressions (RE2), whose time is linear in the text: with Python's own, a template's pattern and a task's text could
block the manager.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from application_manager.core.claims import values
from wayside.api import ApplicationTemplate, freedata
from wayside.api.parameter import Parameter
from wayside.expressions import CelType, Environment, Expression, ExpressionError
from wayside.expressions.bounds import LARGEST_PATTERN, LONGEST_INPUT, pattern_size
from wayside.expressions.errors import EvaluationError

Parameters = Mapping[str, Any]
"""Parameter names to JSON values."""


def without_nulls(parameters: Parameters) -> dict[str, Any]:
    """The given parameters: null means absent."""
    return {name: values.normal(value) for name, value in parameters.items() if value is not None}


def with_defaults(declared: Mapping[str, Parameter], parameters: Parameters) -> dict[str, Any]:
    """The parameters, completed by the defaults of the absent ones, in the order of their names."""
    defaults = {name: values.normal(each.default) for name, each in declared.items() if each.default is not None}
    return dict(sorted((defaults | without_nulls(parameters)).items()))


def size_problem(parameters: Parameters, where: str) -> str:
    """Why the parameters of one task are too large; empty if they are not."""
    size = freedata.size(parameters)
    if size <= freedata.MAXIMUM_BYTES:
        return ""
    return (
        f"{where}: takes {size} bytes as JSON, more than the {freedata.MAXIMUM_BYTES} allowed: "
        "pass a reference to the data instead"
    )


def problems(
    declared: Mapping[str, Parameter], parameters: Parameters, template: str, where: str, *, whole: bool = True
) -> list[str]:
    """Why the parameters do not fit the template; each text has the field under `where`, the value and the remedy.

    Unless the parameters are the `whole`, required ones may be missing.
    """
    too_large = size_problem(parameters, where)
    if too_large:
        return [too_large]
    found = []
    present = without_nulls(parameters)
    for name, value in present.items():
        parameter = declared.get(name)
        if parameter is None:
            found.append(f"{where}.{name}: {values.shown(value)} is given, {_unknown(name, template, declared)}")
        elif problem := _problem(parameter, value):
            found.append(f"{where}.{name}: {problem}")
    for name, parameter in declared.items():
        if whole and parameter.required and name not in present:
            found.append(f"{where}.{name}: is missing, and template {template} requires it: give a {parameter.type}")
    return found


def _unknown(name: str, template: str, declared: Mapping[str, Parameter]) -> str:
    if not declared:
        return f"but template {template} has no parameters: remove it"
    close = difflib.get_close_matches(name, declared, n=1)
    meant = f"did you mean {close[0]}? " if close else ""
    return f"but template {template} has no such parameter: {meant}it has {', '.join(sorted(declared))}"


def _problem(parameter: Parameter, value: Any) -> str | None:
    problem = parameter.problem(value)
    if problem is None and parameter.pattern is not None:
        problem = mismatch(parameter.pattern, value)
    return f"{problem}: {_remedy(parameter)}" if problem else None


def _remedy(parameter: Parameter) -> str:
    kind = f"{parameter.type} of {parameter.items}s" if parameter.items else str(parameter.type)
    bounds = [
        f"{word} {limit:g}"
        for word, limit in (("at least", parameter.minimum), ("at most", parameter.maximum))
        if limit is not None
    ]
    choice = f"one of {', '.join(values.shown(each) for each in parameter.enum)}" if parameter.enum else ""
    match = f"matching {parameter.pattern}" if parameter.pattern else ""
    return "give " + " ".join(part for part in (f"a value of type {kind}", " and ".join(bounds), choice, match) if part)


def baseline(template: ApplicationTemplate) -> dict[str, Any] | None:
    """The values of the template's baseline; None if there is none, or if it is invalid, which the status reports."""
    spec = template.spec
    if spec.baseline is None or _baseline_problems(template):
        return None
    return without_nulls(spec.baseline.parameters)


def _baseline_problems(template: ApplicationTemplate) -> list[str]:
    given_baseline = template.spec.baseline
    if given_baseline is None:
        return []
    return problems(template.spec.parameters, given_baseline.parameters, template.name, "spec.baseline.parameters")


def template_problems(template: ApplicationTemplate) -> list[str]:
    """The problems of the template's parameters and baseline that its model does not check."""
    declared, found = template.spec.parameters, _baseline_problems(template)
    for name, parameter in declared.items():
        if parameter.pattern is None:
            continue
        problem = pattern_problem(parameter.pattern)
        if problem:
            found.append(f"spec.parameters.{name}.pattern: {problem}")
        elif parameter.default is not None and (problem := mismatch(parameter.pattern, parameter.default)):
            found.append(f"spec.parameters.{name}.default: {problem}: correct the default or the bounds")
    return found


_ENVIRONMENT = Environment({"text": CelType.STRING})


def pattern_problem(pattern: str) -> str | None:
    """Why the pattern is invalid; None if it is valid."""
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
    """Why the text, or the array of texts, does not match the pattern; None if it does, or the pattern is invalid."""
    if pattern_problem(pattern):
        return None  # the status of the template reports it, not that of the task
    for index, text in enumerate(value if isinstance(value, list) else [value]):
        which = f"item {index}, {values.shown(text)}," if isinstance(value, list) else values.shown(text)
        if (size := len(text.encode(errors="replace"))) > LONGEST_INPUT:
            return f"{which} has {size} bytes: a parameter with a pattern may have at most {LONGEST_INPUT}"
        # CEL would read only the part before a NUL.
        if "\0" in text or not _matcher(pattern).evaluate({"text": text}):
            return f"{which} does not match the pattern {pattern}"
    return None


@lru_cache(maxsize=256)
def _matcher(pattern: str) -> Expression:
    literal = json.dumps(pattern, ensure_ascii=False)
    return _ENVIRONMENT.compile(f"text.matches({literal})", result=CelType.BOOL)
