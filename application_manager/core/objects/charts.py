"""Helm charts as applications: requests to Helm, and the objects in its output. Pure.

Other modules run the program. This one turns a template and an instance into a request, and the output of `helm
template` into objects. It refuses everything that cannot be applied like a manifest: hooks, because there is no install
or upgrade at which they would run, and CRDs, because they are cluster-wide.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import yaml

from application_manager.core.objects.ownership import ApplyProblem
from wayside.api.applicationtemplate import Helm

UNAVAILABLE = "ChartUnavailable"
"""The reason if the chart cannot be fetched."""
FAILED = "RenderFailed"
"""The reason if the chart cannot be rendered, as for manifests."""

MAXIMUM_OBJECTS = 256
"""In one chart: an instance's status lists them all."""

_DOCUMENT = re.compile(r"^---[ \t]*$", re.MULTILINE)
_SOURCE = re.compile(r"^# Source: (?:[^/\n]*/)?(.+)$", re.MULTILINE)
_HOOK = "helm.sh/hook"


@dataclass(frozen=True, slots=True)
class ChartSource:
    """The source of a chart, from the template."""

    chart: str
    version: str | None = None
    repository: str | None = None

    @classmethod
    def of(cls, helm: Helm) -> ChartSource:
        """The source in a template."""
        return cls(helm.chart, helm.version, helm.repository)

    def __str__(self) -> str:
        version = f" {self.version}" if self.version else ""
        return f"{self.chart}{version}" + (f" of {self.repository}" if self.repository else "")


@dataclass(frozen=True, slots=True)
class ChartRequest:
    """One rendering of a chart: of the instance named by the release, with one set of values as canonical JSON."""

    source: ChartSource
    namespace: str
    release: str
    values: str


@dataclass(frozen=True, slots=True)
class ChartObject:
    """One object of a chart, and the file in the chart that contains it."""

    file: str
    manifest: dict[str, Any]


@dataclass(frozen=True, slots=True)
class ChartObjects:
    """The rendered chart, in Helm's order."""

    objects: tuple[ChartObject, ...]


ChartOutcome = ChartObjects | ApplyProblem

Charts = Callable[[ChartRequest], ChartOutcome | None]
"""Returns the result of a request; None while it is pending."""


def no_charts(request: ChartRequest) -> ChartOutcome:
    """The result without Helm."""
    return ApplyProblem(UNAVAILABLE, f"spec.helm: cannot render chart {request.source} here: helm is not available")


def parse_chart(source: ChartSource, text: str) -> ChartOutcome:
    """The objects in the output of `helm template --include-crds`, or why they cannot be used."""
    objects: list[ChartObject] = []
    problems: list[str] = []
    for part in _DOCUMENT.split(text):
        found = _SOURCE.search(part)
        file = found[1] if found else "?"
        try:
            manifest = yaml.load(part, Loader=_Loader)  # noqa: S506  a safe loader, with fewer types
        except yaml.YAMLError as error:
            problems.append(f"{file} is not YAML: {error}")
            continue
        if manifest is None:
            continue
        found_problems = list(_problems(file, manifest))
        problems += found_problems
        if not found_problems:
            objects.append(ChartObject(file, manifest))
    if len(objects) > MAXIMUM_OBJECTS:
        problems.append(f"it has {len(objects)} objects; at most {MAXIMUM_OBJECTS} are allowed: use a smaller chart")
    if not objects and not problems:
        problems.append("it renders no objects with these values: correct the values")
    if problems:
        return ApplyProblem(FAILED, f"spec.helm: chart {source}: {'; '.join(problems)}")
    return ChartObjects(tuple(objects))


def _problems(file: str, manifest: Any) -> Iterator[str]:
    if not isinstance(manifest, dict) or not all(isinstance(manifest.get(each), str) for each in _LITERAL):
        yield f"{file} contains a document without apiVersion and kind"
        return
    metadata = manifest.get("metadata")
    name = metadata.get("name") if isinstance(metadata, dict) else None
    what = f"{manifest['kind']} {name} in {file}"
    annotations = metadata.get("annotations") if isinstance(metadata, dict) else None
    if isinstance(annotations, dict) and _HOOK in annotations:
        yield (
            f"{what} is a hook ({annotations[_HOOK]}), and hooks are not supported: disable it in the chart's values, "
            "or do its work in the application"
        )
    elif manifest["kind"] == "CustomResourceDefinition":
        yield (
            f"{what} is a CRD, which is cluster-wide: let the administrator install it, and disable it in the chart's "
            "values, or use the chart without its folder crds/"
        )


_LITERAL = ("apiVersion", "kind")


class _Loader(yaml.CSafeLoader):
    """Reads plain scalars as Kubernetes' tools do: a date or a time of day is text, and 1e3 a number."""


_NUMBERS = {
    "tag:yaml.org,2002:int": re.compile(r"[-+]?(0|[1-9][0-9_]*|0[0-7_]+|0x[0-9a-fA-F_]+|0b[01_]+)$"),
    "tag:yaml.org,2002:float": re.compile(
        r"([-+]?([0-9][0-9_]*\.[0-9_]*|\.[0-9][0-9_]*|[0-9][0-9_]*(?=[eE]))([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)"
        r"|\.(nan|NaN|NAN))$"
    ),
}
_Loader.yaml_implicit_resolvers = {
    first: [(tag, _NUMBERS.get(tag, pattern)) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:timestamp"]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
