"""The claim of one task: an instance and values for it, or the reason for its refusal. Pure.

It does not depend on other tasks, only on the task's spec and on the template's parameters and key.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache, partial
from typing import Any

from application_manager.core.claims import parameters, values
from wayside.api import ApplicationTask, ApplicationTemplate
from wayside.api.operation import Operation
from wayside.expressions import CelType, CompiledTemplate, Embedded, Environment, InterpolationError, compile_template

MAXIMUM_KEY_LENGTH = 1024  # characters, as ApplicationInstance's spec.key allows


class RefusalReason(StrEnum):
    """Why a task does not count: reasons of its condition Accepted=False."""

    TEMPLATE_NOT_FOUND = "TemplateNotFound"
    TEMPLATE_INVALID = "TemplateInvalid"
    INVALID_PARAMETERS = "InvalidParameters"
    INVALID_KEY = "InvalidKey"
    CONFLICT = "Conflict"
    OUTBID = "Outbid"
    INSTANCE_NOT_MANAGED = "InstanceNotManaged"
    INVALID_TASK = "InvalidTask"
    EXPRESSION_LIMIT = "ExpressionLimit"
    NOT_ALLOWED = "NotAllowed"


@dataclass(frozen=True, slots=True)
class Refusal:
    """A task that cannot be served, with the reason for programs and for people."""

    reason: RefusalReason
    message: str


@dataclass(frozen=True, slots=True)
class Claim:
    """A task's demand on one instance, or on all of a template.

    Attributes:
        instance: its name, or the result of `all_instances` for the template.
        parameters: the task's own parameters; of a Reconfigure or Suspend task without those of the key.
        instead_of: the instance that is not ready, if this claim is for its fallback.
        fallback: in this case, the fallback template.
    """

    task: ApplicationTask
    instance: str
    key: str | None
    parameters: Mapping[str, Any]
    instead_of: str = ""
    fallback: str = ""

    @property
    def template(self) -> str:
        """The instance's template."""
        return self.fallback or self.task.spec.template_name

    @property
    def operation(self) -> Operation:
        """The operation of the task."""
        return self.task.spec.operation


@dataclass(frozen=True, slots=True)
class InvalidTemplate:
    """A template that cannot be used: the API server accepted it, but it is not valid."""

    name: str
    problem: str


TemplateState = ApplicationTemplate | InvalidTemplate | None
"""A template, valid or not; None if it does not exist."""


def claim(template: TemplateState, task: ApplicationTask) -> Claim | Refusal:
    """The claim of the task on its template, or why it is refused; `template` is None if it does not exist."""
    if isinstance(template, InvalidTemplate):
        message = f"spec.templateName: ApplicationTemplate {template.name} is not valid: {template.problem}"
        return Refusal(RefusalReason.TEMPLATE_INVALID, f"{message}; correct the template")
    if template is None:
        return Refusal(
            RefusalReason.TEMPLATE_NOT_FOUND,
            f"spec.templateName: there is no ApplicationTemplate {task.spec.template_name!r} in namespace "
            f"{task.namespace}: create it, or correct the rule that emitted this task",
        )
    declared = template.spec.parameters
    deploys = task.spec.operation is Operation.DEPLOY
    problems = parameters.problems(declared, task.spec.parameters, template.name, "spec.parameters", whole=deploys)
    if problems:
        return Refusal(RefusalReason.INVALID_PARAMETERS, "; ".join(problems))
    given = parameters.without_nulls(task.spec.parameters)
    if not deploys:
        return _claim_on_existing(template, task, given)
    if template.spec.key is None:
        return Claim(task, template.name, None, given)
    key = _key_or_refusal(template, given)
    return key if isinstance(key, Refusal) else Claim(task, instance_name(template.name, key), key, given)


def _claim_on_existing(
    template: ApplicationTemplate, task: ApplicationTask, given: Mapping[str, Any]
) -> Claim | Refusal:
    """The claim of a task that reconfigures or suspends: on the instance of its key, or on all."""
    declared, operation = template.spec.parameters, task.spec.operation
    try:
        of_key = key_parameters(template)
    except InterpolationError as error:
        return Refusal(RefusalReason.INVALID_KEY, f"the key of template {template.name}, {error}")
    rest = {name: value for name, value in given.items() if name not in of_key}
    if operation is Operation.SUSPEND and rest:
        name, value = next(iter(rest.items()))
        return Refusal(
            RefusalReason.INVALID_PARAMETERS,
            f"spec.parameters.{name}: {values.shown(value)} is given, but a Suspend task cannot change parameters: "
            f"remove it{_which(of_key)}",
        )
    if operation is Operation.RECONFIGURE and not rest:
        return Refusal(
            RefusalReason.INVALID_PARAMETERS,
            f"spec.parameters: {values.shown(dict(given))} changes nothing: give at least one parameter of "
            f"template {template.name}{_which(of_key)}",
        )
    if template.spec.key is None:
        return Claim(task, template.name, None, rest)
    if not of_key & given.keys():
        return Claim(task, all_instances(template.name), None, rest)
    missing = sorted(name for name in of_key - given.keys() if declared[name].default is None)
    if missing:
        return Refusal(
            RefusalReason.INVALID_KEY,
            f"spec.parameters.{missing[0]}: is missing, but the key of template {template.name} ({template.spec.key}) "
            "needs it to identify the instance: give it, or omit all parameters of the key to select all instances",
        )
    key = _key_or_refusal(template, given)
    return key if isinstance(key, Refusal) else Claim(task, instance_name(template.name, key), key, rest)


def _which(of_key: frozenset[str]) -> str:
    return f" (parameters of the key only identify the instance: {', '.join(sorted(of_key))})" if of_key else ""


def _key_or_refusal(template: ApplicationTemplate, given: Mapping[str, Any]) -> str | Refusal:
    try:
        key = instance_key(template, parameters.with_defaults(template.spec.parameters, given))
    except InterpolationError as error:
        return Refusal(RefusalReason.INVALID_KEY, f"the key of template {template.name}, {error}")
    if len(key) > MAXIMUM_KEY_LENGTH:
        return Refusal(
            RefusalReason.INVALID_KEY,
            f"the key of template {template.name} ({template.spec.key}) has {len(key)} characters for this task; at "
            f"most {MAXIMUM_KEY_LENGTH} are allowed: use shorter parameters",
        )
    return key


def all_instances(template: str) -> str:
    """The name that stands for all instances of the template; no instance has this name."""
    return f"{template}/*"


def template_of_all(instance: str) -> str | None:
    """The template, if the name stands for all its instances; else None."""
    return instance.removesuffix("/*") if instance.endswith("/*") else None


def instance_name(template: str, key: str | None) -> str:
    """The instance's name: the template's name and, with a key, 10 characters that are computed from the key."""
    if key is None:
        return template
    digest = hashlib.sha256(key.encode()).digest()
    return f"{template}-{base64.b32encode(digest)[:10].decode().lower()}"


def instance_key(template: ApplicationTemplate, complete: Mapping[str, Any]) -> str:
    """The key's value as text, from a task's parameters completed by the defaults.

    Raises InterpolationError if the key does not compile, reads an unknown parameter, or has no value.
    """
    declared = tuple(sorted(template.spec.parameters))
    compiled = _compiled_key(template.spec.key or "", declared)
    value = compiled.render({"parameters": {name: complete.get(name) for name in declared}})
    if value is None:
        raise InterpolationError(
            "is null for this task", path="spec.key", hint="give the parameters that the key refers to"
        )
    return values.text(value)


def key_parameters(template: ApplicationTemplate) -> frozenset[str]:
    """The parameters that the key reads; none if there is no key.

    Raises InterpolationError if the key does not compile, or reads an unknown parameter.
    """
    if template.spec.key is None:
        return frozenset()
    declared = tuple(sorted(template.spec.parameters))
    paths = _compiled_key(template.spec.key, declared).paths
    if any(len(path) == 1 for path in paths):  # it reads the whole map
        return frozenset(declared)
    return frozenset(str(path[1]) for path in paths)


@lru_cache(maxsize=1024)
def _compiled_key(source: str, declared: tuple[str, ...]) -> CompiledTemplate:
    environment, check = Environment({"parameters": CelType.MAP}), partial(unknown_members, {"parameters": declared})
    return compile_template(source, environment, path="spec.key", check=check)


def unknown_members(known: Mapping[str, tuple[str, ...]], each: Embedded) -> Iterator[InterpolationError]:
    """The problem of a `${name.member}` with an unknown member; `known` has the members of each name."""
    for path in sorted(each.expression.paths, key=str):
        members = known.get(str(path[0]))
        if members is None or len(path) < 2 or path[1] in members:
            continue
        hint = f"there {'is' if len(members) == 1 else 'are'} {', '.join(members) or 'none'}"
        if each.text.strip() != f"${{{each.expression.source}}}":
            hint += "; write `$${` for a literal `${`"
        yield each.error(f"`{path[0]}.{path[1]}` does not exist", hint)
