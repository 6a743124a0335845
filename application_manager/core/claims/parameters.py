"""Checks the parameters of tasks against those that the template declares.

Pure. A task whose values do not fit is refused as a whole, and then contributes nothing to any parameter.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any

from application_manager.core.claims import patterns, values
from wayside.api import ApplicationTemplate, freedata
from wayside.api.parameter import Parameter

Parameters = Mapping[str, Any]
"""Parameter names to JSON values."""


def given(parameters: Parameters) -> dict[str, Any]:
    """The parameters that are really given: null means absent."""
    return {name: values.normal(value) for name, value in parameters.items() if value is not None}


def with_defaults(declared: Mapping[str, Parameter], parameters: Parameters) -> dict[str, Any]:
    """The parameters, and the defaults of those that are not among them, in the order of their names."""
    defaults = {name: values.normal(each.default) for name, each in declared.items() if each.default is not None}
    return dict(sorted((defaults | given(parameters)).items()))


def size_problem(parameters: Parameters, where: str) -> str:
    """Why the parameters of one task are too large; empty where they are not."""
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
    """Why the parameters do not fit the template; each text names the field under `where`, the value and the remedy.

    Required ones may be missing where the parameters are not meant to be the `whole`.
    """
    too_large = size_problem(parameters, where)
    if too_large:
        return [too_large]
    found = []
    present = given(parameters)
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
        problem = patterns.mismatch(parameter.pattern, value)
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
    """The values of the template's baseline; None where it has none, or a wrong one, which its status reports."""
    spec = template.spec
    if spec.baseline is None or _baseline_problems(template):
        return None
    return given(spec.baseline.parameters)


def _baseline_problems(template: ApplicationTemplate) -> list[str]:
    given_baseline = template.spec.baseline
    if given_baseline is None:
        return []
    return problems(template.spec.parameters, given_baseline.parameters, template.name, "spec.baseline.parameters")


def template_problems(template: ApplicationTemplate) -> list[str]:
    """What is wrong with the template's parameters and its baseline, beside what its model has checked."""
    declared, found = template.spec.parameters, _baseline_problems(template)
    for name, parameter in declared.items():
        if parameter.pattern is None:
            continue
        problem = patterns.pattern_problem(parameter.pattern)
        if problem:
            found.append(f"spec.parameters.{name}.pattern: {problem}")
        elif parameter.default is not None and (problem := patterns.mismatch(parameter.pattern, parameter.default)):
            found.append(f"spec.parameters.{name}.default: {problem}: correct the default or the bounds")
    return found
