"""Example values to render a template with before any task exists. Pure.

A default, a member of an enum and both booleans are values that will come; all others are made up. So what goes wrong
on these is only a remark, and on those a fault of the template.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from wayside.api import ApplicationTemplate
from wayside.api.parameter import Parameter, ParameterType

_ITEMS: Mapping[str, Any] = {"string": "example", "number": 1, "integer": 1, "boolean": True}


@dataclass(frozen=True, slots=True)
class Example:
    """Parameters of one instance.

    Attributes:
        given: those that tasks give; defaults come in besides.
        made_up: the names of those whose value is no task's, nor the template's.
        phrase: when it is so, to end a sentence.
    """

    given: Mapping[str, Any]
    made_up: frozenset[str]
    phrase: str


def examples(template: ApplicationTemplate) -> tuple[Example, ...]:
    """The baseline where there is one, the least that a task may give, and all that it can."""
    baseline = template.spec.baseline
    if baseline is None:
        return _of_tasks(template.spec.parameters)
    given = {name: each for name, each in baseline.parameters.items() if each is not None}
    return (Example(given, frozenset(), "for the baseline"), *_of_tasks(template.spec.parameters))


def _of_tasks(declared: Mapping[str, Parameter]) -> tuple[Example, ...]:
    optional = frozenset(name for name, each in declared.items() if not each.required and each.default is None)
    required = {name: example_of(each) for name, each in declared.items() if each.required}
    made_up = frozenset(name for name in required if not _is_real(declared[name]))
    given = f"only {', '.join(sorted(required))}" if required else "no parameters"
    least = Example(required, made_up | optional, f"when tasks give {given}")
    if not optional:
        return (least,)
    every = {name: example_of(each) for name, each in declared.items() if each.default is None}
    made_up = frozenset(name for name in every if not _is_real(declared[name]))
    return (least, Example(every, made_up, "when tasks give all parameters"))


def example_of(parameter: Parameter) -> Any:
    """A value within the parameter's bounds; of a pattern it knows nothing."""
    if parameter.default is not None:
        return parameter.default
    if parameter.enum:
        return parameter.enum[0]
    match parameter.type:
        case ParameterType.STRING:
            return "example"
        case ParameterType.BOOLEAN:
            return False
        case ParameterType.OBJECT:
            return {}
        case ParameterType.ARRAY:
            return [] if parameter.items is None else [_ITEMS[parameter.items]]
    low = 1.0 if parameter.minimum is None else parameter.minimum
    within = low if parameter.maximum is None else min(low, parameter.maximum)
    return within


def is_open(parameter: Parameter) -> bool:
    """Whether values may be of a shape that cannot be guessed, so that an example that fails proves nothing."""
    shapeless = parameter.type in (ParameterType.OBJECT, ParameterType.ARRAY) or parameter.pattern is not None
    return shapeless and not _is_real(parameter)


def _is_real(parameter: Parameter) -> bool:
    return parameter.default is not None or bool(parameter.enum) or parameter.type is ParameterType.BOOLEAN
