"""Rendering: a template and an instance give manifests; equal input gives equal bytes. Pure.

A `Renderer` contains a template that is compiled once; `render` evaluates it for an instance. If the template violates
a rule, the error names the field, the value and the remedy, and nothing is rendered.
"""

from __future__ import annotations

import copy
import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, cast

from application_manager.core.claims import parameters, values
from application_manager.core.claims.claims import unknown_members
from application_manager.core.objects.charts import ChartRequest, Charts, ChartSource, no_charts
from application_manager.core.objects.configuration import CONFIG_MAP, Configuration, config_map, config_map_name
from application_manager.core.objects.ownership import ApplyProblem, Manifest, ObjectKey, labelled, object_key
from application_manager.core.objects.policy import KindKey, Policy
from application_manager.core.objects.suspension import scaled_to_zero, stated_replicas, without_autoscaled_replicas
from wayside.api import ApplicationInstance, ApplicationTemplate
from wayside.api.applicationtemplate import Helm
from wayside.api.base import LABEL, SUBDOMAIN
from wayside.expressions import CelType, CompiledTemplate, Embedded, Environment, InterpolationError, compile_template

_INSTANCE_VARIABLES = ("name", "key", "namespace")
_WITH_CONFIGURATION = (*_INSTANCE_VARIABLES, "configMap")
_ENVIRONMENT = Environment({"parameters": CelType.MAP, "instance": CelType.MAP})
_RESERVED_METADATA = ("ownerReferences", "generateName", "uid", "resourceVersion", "managedFields", "finalizers")

_LONGEST_NAME = 253  # characters
_SERVICE: KindKey = ("v1", "Service")
_LONGEST_NAMES: dict[KindKey, int] = {_SERVICE: 63, ("batch/v1", "Job"): 63, ("batch/v1", "CronJob"): 52}

MOST_EXPRESSIONS = 1000
"""In one template: each takes about a millisecond to compile, and no template may block the manager."""


class RenderError(Exception):
    """A template that cannot be rendered; `problems` has all errors, each with field, value and remedy."""

    def __init__(self, problems: list[str], reason: str = "RenderFailed") -> None:
        super().__init__("; ".join(problems))
        self.problems = tuple(problems)
        self.reason = reason


class ChartPending(Exception):  # noqa: N818  not an error: the result is pending
    """The instance's chart is being rendered; render again once it is."""

    def __init__(self, request: ChartRequest) -> None:
        super().__init__(f"chart {request.source} is being rendered")
        self.request = request


@dataclass(frozen=True, slots=True)
class Rendering:
    """The objects of an instance: manifests without owner, which `owned` adds, and a digest of them all.

    `replicas`: of each workload with replicas, the number in the template; None if the template does not set it.
    """

    manifests: tuple[Manifest, ...]
    digest: str
    replicas: Mapping[ObjectKey, int | None] = field(default_factory=dict)

    def keys(self) -> set[ObjectKey]:
        """The keys of the objects: apiVersion, kind and name of each."""
        return {object_key(each) for each in self.manifests}


class Renderer:
    """A template, compiled.

    Raises RenderError for expressions that do not compile or read unknown names, and for kinds that are not allowed.
    """

    def __init__(self, template: ApplicationTemplate, policy: Policy) -> None:
        self.template = template
        self._policy = policy
        if (count := _expressions(template)) > MOST_EXPRESSIONS:
            raise RenderError(
                [
                    f"spec: has {count} expressions in ${{…}}; a template may have at most {MOST_EXPRESSIONS}: use "
                    "fewer expressions, or split the template"
                ]
            )
        self._keyed = template.spec.key is not None
        self._manifests: list[CompiledTemplate] = []
        problems = parameters.template_problems(template)
        configured = bool(template.spec.configuration)
        members = _WITH_CONFIGURATION if configured else _INSTANCE_VARIABLES
        known = {"parameters": tuple(sorted(template.spec.parameters)), "instance": members}
        check = partial(unknown_members, known)
        self._configuration: Configuration | None = None
        if configured:
            if problem := policy.kind_problem(*CONFIG_MAP):
                problems.append(f"spec.configuration: becomes a ConfigMap, but {problem}")
            try:
                self._configuration = Configuration(template.spec.configuration, _ENVIRONMENT, check)
            except InterpolationError as error:
                problems += error_texts(error)
        for index, manifest in enumerate(template.spec.manifests):
            path = f"spec.manifests[{index}]"
            if problem := policy.kind_problem(manifest["apiVersion"], manifest["kind"]):
                problems.append(f"{path}.kind: {problem}")
            try:
                self._manifests.append(compile_template(manifest, _ENVIRONMENT, path=path, check=check))
            except InterpolationError as error:
                problems += error_texts(error)
        self._values: CompiledTemplate | None = None
        if (helm := template.spec.helm) is not None:
            try:
                self._values = compile_template(helm.values, _ENVIRONMENT, path="spec.helm.values", check=check)
            except InterpolationError as error:
                problems += error_texts(error)
        if problems:
            raise RenderError(problems)

    @property
    def embedded(self) -> tuple[Embedded, ...]:
        """All expressions of the template except the key, with their fields."""
        compiled = [*self._manifests, *([self._values] if self._values is not None else [])]
        of_files = self._configuration.embedded if self._configuration is not None else ()
        return (*of_files, *(each for one in compiled for each in one.embedded))

    def render(self, instance: ApplicationInstance, charts: Charts = no_charts) -> Rendering:
        """The instance's objects; `charts` returns the results of charts.

        Raises RenderError if an expression fails with the instance's values, or a manifest is not allowed, and
        ChartPending while the chart is being rendered.
        """
        spec = self.template.spec
        problems = parameters.problems(spec.parameters, instance.spec.parameters, self.template.name, "spec.parameters")
        if problems:
            raise RenderError(problems)
        complete = parameters.with_defaults(spec.parameters, instance.spec.parameters)
        about = {"name": instance.name, "key": instance.spec.key, "namespace": instance.namespace}
        if self._configuration is not None:
            about["configMap"] = config_map_name(instance.name)
        variables = {"parameters": {name: complete.get(name) for name in spec.parameters}, "instance": about}
        manifests: list[Manifest] = []
        if self._configuration is not None:
            files, problems = self._configuration.render(variables)
            manifests.append(labelled(config_map(instance.name, files), instance))
        for index, compiled in enumerate(self._manifests):
            path = f"spec.manifests[{index}]"
            try:
                # Copied, because rendering returns parts of the template that contain no ${…} themselves.
                manifest = cast("Manifest", copy.deepcopy(compiled.render(variables, integers=True)))
            except InterpolationError as error:
                problems.append(str(error))
                continue
            found = [f"{path}.{field}: {problem}" for field, problem in self._problems(manifest, instance)]
            problems += found
            if not found:
                manifests.append(labelled(self._policy.completed(manifest), instance))
        if spec.helm is not None and self._values is not None and not problems:
            for where, manifest in self._chart_manifests(spec.helm, self._values, instance, variables, charts):
                found = [f"{where}: {field}: {problem}" for field, problem in self._problems(manifest, instance)]
                if kind_problem := self._policy.kind_problem(manifest["apiVersion"], manifest["kind"]):
                    found.append(f"{where}: {kind_problem}; or disable it in the chart's values")
                problems += found
                if not found:
                    manifests.append(labelled(self._policy.completed(manifest), instance))
        problems += _duplicates(manifests)
        if problems:
            raise RenderError(problems)
        manifests = without_autoscaled_replicas(manifests)
        replicas = stated_replicas(manifests)
        if instance.spec.suspended:
            manifests = scaled_to_zero(manifests)
        return Rendering(tuple(manifests), digest(manifests), replicas)

    def _chart_manifests(
        self,
        helm: Helm,
        compiled: CompiledTemplate,
        instance: ApplicationInstance,
        variables: Mapping[str, Any],
        charts: Charts,
    ) -> Iterator[tuple[str, Manifest]]:
        """The chart's objects, each with its place."""
        try:
            given = compiled.render(variables, integers=True)
        except InterpolationError as error:
            raise RenderError([str(error)]) from None
        request = ChartRequest(ChartSource.of(helm), instance.namespace, instance.name, values.canonical(given or {}))
        outcome = charts(request)
        if outcome is None:
            raise ChartPending(request)
        if isinstance(outcome, ApplyProblem):
            raise RenderError([outcome.message], outcome.reason)
        for each in outcome.objects:
            # Copied and normalised, because the chart's objects stay in the cache.
            yield f"spec.helm: {each.file} of chart {helm.chart}", cast("Manifest", values.normal(each.manifest))

    def _problems(self, manifest: Manifest, instance: ApplicationInstance) -> Iterator[tuple[str, str]]:
        metadata = manifest.get("metadata")
        if not isinstance(metadata, dict):
            yield "metadata", "is missing: give metadata.name"
            return
        name = metadata.get("name")
        if not isinstance(name, str) or not name:
            yield "metadata.name", f"must be a string, e.g. ${{instance.name}}; got {values.shown(name)}"
        elif problem := _name_problem((manifest["apiVersion"], manifest["kind"]), name):
            yield "metadata.name", problem
        elif self._keyed and instance.name not in name:
            yield (
                "metadata.name",
                f"{name!r} would be the same for several instances: with spec.key, each name must contain "
                "${instance.name}",
            )
        namespace = metadata.get("namespace", instance.namespace)
        if namespace != instance.namespace:
            yield (
                "metadata.namespace",
                f"{namespace!r} is not the template's own namespace, {instance.namespace}: remove the field, or "
                "create the template in that namespace",
            )
        for reserved in _RESERVED_METADATA:
            if reserved in metadata:
                yield f"metadata.{reserved}", "is set by the manager: remove it"
        for member in ("labels", "annotations"):
            texts = metadata.get(member)
            if texts is not None and not isinstance(texts, dict):
                yield f"metadata.{member}", f"must be a map of strings; got {values.shown(texts)}"
        yield from self._policy.pod_problems(manifest)


def _name_problem(kind: KindKey, name: str) -> str:
    """Why an object of the kind may not have the name; empty where it may."""
    longest = _LONGEST_NAMES.get(kind, _LONGEST_NAME)
    pattern, characters = (LABEL, "digits and -") if kind == _SERVICE else (SUBDOMAIN, "digits, - and .")
    if len(name) <= longest and re.fullmatch(pattern, name):
        return ""
    return (
        f"must have at most {longest} lower-case letters, {characters}, with a letter or digit at both ends; got "
        f"{values.shown(name)}"
    )


def error_texts(error: InterpolationError) -> list[str]:
    """The error, and all further ones in it."""
    return [str(each) for each in (error, *error.others)]


def digest(manifests: list[Manifest]) -> str:
    """A digest of manifests: equal if and only if their canonical bytes are equal."""
    return hashlib.sha256(values.canonical(manifests).encode()).hexdigest()


def _expressions(template: ApplicationTemplate) -> int:
    """The number of `${` to compile."""
    spec = template.spec
    text = json.dumps([spec.configuration, spec.manifests, spec.helm.values if spec.helm is not None else None])
    return text.count("${") - text.count("$${")


def _duplicates(manifests: list[Manifest]) -> list[str]:
    seen: set[ObjectKey] = set()
    found = []
    for manifest in manifests:
        key = object_key(manifest)
        if key in seen:
            found.append(f"spec.manifests: {key[1]} {key[2]!r} is given twice: names must be unique")
        seen.add(key)
    return found
