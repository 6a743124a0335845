"""What tasks say, checked against what the template asks for, and merged into one value for each parameter.

Pure. A task whose values do not fit is refused as a whole, and then contributes nothing to any parameter.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from application_manager.core import values
from wayside.api.applicationtask import MAXIMUM_PARAMETER_BYTES
from wayside.api.applicationtemplate import Merge, Parameter

Parameters = Mapping[str, Any]
"""Parameter names to JSON values."""


def given(parameters: Parameters) -> dict[str, Any]:
    """The parameters that are really given: null means absent."""
    return {name: values.normal(value) for name, value in parameters.items() if value is not None}


def with_defaults(declared: Mapping[str, Parameter], parameters: Parameters) -> dict[str, Any]:
    """The parameters, and the defaults of those that are not among them, in the order of their names."""
    defaults = {name: values.normal(each.default) for name, each in declared.items() if each.default is not None}
    return dict(sorted((defaults | given(parameters)).items()))


def problems(declared: Mapping[str, Parameter], parameters: Parameters, template: str, where: str) -> list[str]:
    """Why the parameters do not fit the template; each text names the field under `where`, the value and the remedy."""
    size = len(json.dumps(dict(parameters), ensure_ascii=False, separators=(",", ":")).encode())
    if size > MAXIMUM_PARAMETER_BYTES:
        return [
            f"{where}: takes {size} bytes as JSON, more than the {MAXIMUM_PARAMETER_BYTES} allowed: "
            "pass a reference to the data instead"
        ]
    found = []
    present = given(parameters)
    for name, value in present.items():
        parameter = declared.get(name)
        if parameter is None:
            found.append(f"{where}.{name}: {values.shown(value)} is given, {_unknown(name, template, declared)}")
        elif problem := _problem(parameter, value):
            found.append(f"{where}.{name}: {problem}")
    for name, parameter in declared.items():
        if parameter.required and name not in present:
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
    return f"{problem}: {_remedy(parameter)}" if problem else None


def _remedy(parameter: Parameter) -> str:
    kind = f"{parameter.type} of {parameter.items}s" if parameter.items else str(parameter.type)
    bounds = [
        f"{word} {limit:g}"
        for word, limit in (("at least", parameter.minimum), ("at most", parameter.maximum))
        if limit is not None
    ]
    choice = f"one of {', '.join(values.shown(each) for each in parameter.enum)}" if parameter.enum else ""
    return "give " + " ".join(part for part in (f"a value of type {kind}", " and ".join(bounds), choice) if part)


@dataclass(frozen=True, slots=True)
class Contribution:
    """The values of one task."""

    task: str
    parameters: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Conflict:
    """A task that differs from an earlier one in a parameter on which all must agree."""

    parameter: str
    value: Any
    other: Any
    other_task: str

    def message(self) -> str:
        """The refusal, with field, value and remedy."""
        return (
            f"spec.parameters.{self.parameter}: {values.shown(self.value)} differs from {values.shown(self.other)} of "
            f"task {self.other_task}, and its merge strategy is Same: give the same value, wait until that task ends, "
            "or let the template's key tell the two apart"
        )


@dataclass(frozen=True, slots=True)
class Merged:
    """One set of parameters for the instance, and the tasks that could not take part."""

    parameters: dict[str, Any]
    conflicts: dict[str, Conflict]


def merge(declared: Mapping[str, Parameter], contributions: Sequence[Contribution]) -> Merged:
    """Merge the tasks' values, which fit the template, in the order given: the first of them has precedence."""
    agreed: dict[str, tuple[str, Any, str]] = {}  # name → canonical value, value, task
    taken: list[Contribution] = []
    conflicts: dict[str, Conflict] = {}
    for each in contributions:
        conflict = _conflict(declared, agreed, each)
        if conflict is not None:
            conflicts[each.task] = conflict
            continue
        taken.append(each)
        for name, value in each.parameters.items():
            if declared[name].merge is Merge.SAME and name not in agreed:
                agreed[name] = (values.canonical(value), value, each.task)
    result: dict[str, Any] = {}
    for name, parameter in declared.items():
        said = [each.parameters[name] for each in taken if name in each.parameters]
        if said:
            result[name] = _merged(parameter.merge, said)
    return Merged(with_defaults(declared, result), conflicts)


def _conflict(
    declared: Mapping[str, Parameter], agreed: Mapping[str, tuple[str, Any, str]], each: Contribution
) -> Conflict | None:
    for name, value in sorted(each.parameters.items()):
        if declared[name].merge is not Merge.SAME or name not in agreed:
            continue
        text, other, task = agreed[name]
        if values.canonical(value) != text:
            return Conflict(name, value, other, task)
    return None


def _merged(strategy: Merge, said: Sequence[Any]) -> Any:
    match strategy:
        case Merge.SAME | Merge.HIGHEST_PRIORITY:
            return said[0]
        case Merge.MAX:
            return max(said)
        case Merge.MIN:
            return min(said)
        case Merge.UNION:
            items = {values.canonical(item): item for each in said for item in each}
            return sorted(items.values(), key=values.sort_key)
