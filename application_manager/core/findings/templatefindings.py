"""Finds errors in an ApplicationTemplate before any task names it. Pure.

It is compiled, the types of the parameters in its expressions are checked, and it is rendered with examples. A failure
with an example is an error of the template only if no value of a task could avoid it; otherwise it is a remark or, if
the example proves nothing, it is ignored. A default, a member of an enum and both booleans are real values; all others
are made up.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from application_manager.core.claims import claims, parameters
from application_manager.core.findings.checks import FAILING_EXAMPLE
from application_manager.core.findings.findings import Findings, field_of
from application_manager.core.objects.charts import ChartObjects, ChartOutcome, ChartRequest
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import Renderer, RenderError, error_texts
from wayside.api import ApplicationInstance, ApplicationTemplate
from wayside.api.base import Metadata
from wayside.api.parameter import Parameter, ParameterType
from wayside.expressions import CelType, Environment, InterpolationError, compile_template
from wayside.expressions.syntax import Path
from wayside.findings import Finding, ignored_by

_KINDS: Mapping[ParameterType, CelType] = {
    ParameterType.STRING: CelType.STRING,
    ParameterType.NUMBER: CelType.DOUBLE,
    ParameterType.INTEGER: CelType.DOUBLE,
    ParameterType.BOOLEAN: CelType.BOOL,
    ParameterType.ARRAY: CelType.LIST,
    ParameterType.OBJECT: CelType.MAP,
}
_VARIABLES = {"parameters": CelType.MAP, "instance": CelType.MAP}
_NAMES = "metadata.name"

_ITEMS: Mapping[str, Any] = {"string": "example", "number": 1, "integer": 1, "boolean": True}

Reads = Iterable[tuple[str, frozenset[Path]]]
"""Fields, each with the parameters that its expressions read."""


@dataclass(frozen=True, slots=True)
class Example:
    """Parameters of one instance, as tasks give them; the defaults are added.

    `made_up`: the parameters with made-up values; `phrase`: when this occurs, for the end of a sentence.
    """

    given: Mapping[str, Any]
    made_up: frozenset[str]
    phrase: str


def template_findings(template: ApplicationTemplate, policy: Policy) -> Findings:
    """The findings about the template."""
    problems: list[str] = []
    try:
        Renderer(template, policy)
    except RenderError as error:
        problems += error.problems
    try:
        claims.key_parameters(template)
    except InterpolationError as error:
        problems += error_texts(error)
    if not problems:
        problems += _mistyped(template)
    if problems:
        return Findings(tuple(dict.fromkeys(problems)))
    return _on_examples(template, policy)


def _mistyped(template: ApplicationTemplate) -> Iterator[str]:
    """Expressions that use a parameter as another type; a parameter that may be null has any type."""
    declared = template.spec.parameters
    kinds = {
        f"parameters.{name}": _KINDS[each.type]
        for name, each in declared.items()
        if each.required or each.default is not None
    }
    if not kinds:
        return
    environment = Environment(_VARIABLES).knowing(kinds)
    for path, value in _texts(template):
        try:
            compile_template(value, environment, path=path)
        except InterpolationError as error:
            yield from error_texts(error)


def _texts(template: ApplicationTemplate) -> Iterator[tuple[str, Any]]:
    spec = template.spec
    if spec.key is not None:
        yield "spec.key", spec.key
    for name, content in sorted(spec.configuration.items()):
        yield f"spec.configuration.{name}", content
    for index, manifest in enumerate(spec.manifests):
        yield f"spec.manifests[{index}]", manifest
    if spec.helm is not None:
        yield "spec.helm.values", spec.helm.values


def _on_examples(template: ApplicationTemplate, policy: Policy) -> Findings:
    problems: list[str] = []
    remarks: list[Finding] = []
    loose = _without_patterns(template)
    renderer = Renderer(loose, policy)
    reads = [(each.path, each.expression.paths) for each in renderer.embedded]
    unguessable = frozenset(name for name, each in template.spec.parameters.items() if is_open(each))
    for example in examples(template):
        for problem in _rendered(loose, renderer, example):
            read = _read(problem, loose, reads)
            if not read & example.made_up:
                problems.append(problem)
            elif not read & unguessable & example.given.keys():
                remarks.append(Finding(FAILING_EXAMPLE.name, f"{problem}; this occurs {example.phrase}"))
    if FAILING_EXAMPLE.name in ignored_by(template.metadata.annotations):
        remarks.clear()
    return Findings(tuple(dict.fromkeys(problems)), remarks=tuple(dict.fromkeys(remarks)))


def _without_patterns(template: ApplicationTemplate) -> ApplicationTemplate:
    """The template for examples: without patterns, which the examples do not match."""
    loose: dict[str, Parameter] = {
        name: each.model_copy(update={"pattern": None}) for name, each in template.spec.parameters.items()
    }
    return template.model_copy(update={"spec": template.spec.model_copy(update={"parameters": loose})})


def _rendered(template: ApplicationTemplate, renderer: Renderer, example: Example) -> tuple[str, ...]:
    """The problems when the example's instance is rendered."""
    complete = parameters.with_defaults(template.spec.parameters, example.given)
    key = None
    if template.spec.key is not None:
        try:
            key = claims.instance_key(template, complete)
        except InterpolationError as error:
            return (str(error),)
    instance = ApplicationInstance.model_validate(
        {
            "kind": "ApplicationInstance",
            "metadata": Metadata(name=claims.instance_name(template.name, key), namespace=template.namespace),
            "spec": {"templateName": template.name, "key": key, "parameters": dict(example.given)},
        }
    )
    try:
        renderer.render(instance, _no_objects)
    except RenderError as error:
        return error.problems
    return ()


def _no_objects(_: ChartRequest) -> ChartOutcome:
    """No objects for a chart: without fetching it, only its values can be checked."""
    return ChartObjects(())


def _read(problem: str, template: ApplicationTemplate, reads: Reads) -> frozenset[str]:
    """The parameters on which a problem may depend."""
    field = field_of(problem)
    if field == "spec.key":
        return claims.key_parameters(template)
    if field == "spec.manifests":  # two objects with the same name
        touched = [paths for path, paths in reads if path.endswith(_NAMES)]
    else:
        touched = [paths for path, paths in reads if _within(path, field) or _within(field, path)]
    every = frozenset(template.spec.parameters)
    return frozenset().union(*map(partial(_parameters, every), touched))


def _parameters(every: frozenset[str], paths: frozenset[Path]) -> frozenset[str]:
    of_parameters = [path for path in paths if path[0] == "parameters"]
    if any(len(path) == 1 for path in of_parameters):  # it reads the whole map
        return every
    return frozenset(str(path[1]) for path in of_parameters)


def _within(field: str, other: str) -> bool:
    """Whether the field is the other one, or a part of it."""
    return field == other or (field.startswith(other) and field[len(other)] in ".[")


def examples(template: ApplicationTemplate) -> tuple[Example, ...]:
    """The examples: the baseline if there is one, the minimum that a task may give, and all parameters."""
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
    """A value within the parameter's bounds; patterns are ignored."""
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
    """Whether the parameter's values may have any shape, so that a failure with an example proves nothing."""
    shapeless = parameter.type in (ParameterType.OBJECT, ParameterType.ARRAY) or parameter.pattern is not None
    return shapeless and not _is_real(parameter)


def _is_real(parameter: Parameter) -> bool:
    return parameter.default is not None or bool(parameter.enum) or parameter.type is ParameterType.BOOLEAN
