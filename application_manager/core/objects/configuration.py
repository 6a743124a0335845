"""Live configuration: the files of a template become the texts of one ConfigMap of the instance. Pure.

It is a separate ConfigMap, so that a change reaches the running application without a change of the pod template, which
would replace the pods. A text stays unchanged; a map, a list, a number or a boolean is written in the format of the
file's extension.

The kubelet writes a changed ConfigMap into a pod at its next sync of that pod, which may be more than a minute later.
It syncs immediately when the pod itself changes, and an annotation is enough: a hash of the content, so that the same
content is never announced twice.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from application_manager.core.claims import values
from application_manager.core.objects.ownership import ObjectKey
from application_manager.core.objects.podspecs import pod_template
from wayside.expressions import CompiledTemplate, Embedded, Environment, InterpolationError, compile_template
from wayside.manifests import to_yaml

CONFIG_MAP = ("v1", "ConfigMap")
MAXIMUM_BYTES = 1_000_000  # of all files; the API server accepts 1 MiB per ConfigMap, and etcd 1.5 MiB per object

ANNOTATION = "wayside.dev/configuration"
"""On a pod: the `fingerprint` of the configuration that was last announced to it."""

Object = Mapping[str, Any]

_OVER = ("Succeeded", "Failed")

Check = Callable[[Embedded], Iterable[InterpolationError]]


def config_map_name(instance: str) -> str:
    """The name of an instance's ConfigMap, for `${instance.configMap}`."""
    return f"{instance}-configuration"


def config_map_key(instance: str) -> ObjectKey:
    """The key of the ConfigMap."""
    return (*CONFIG_MAP, config_map_name(instance))


def config_map(instance: str, files: Mapping[str, str]) -> dict[str, Any]:
    """The ConfigMap that holds the files, without namespace, labels and owner."""
    return {
        "apiVersion": CONFIG_MAP[0],
        "kind": CONFIG_MAP[1],
        "metadata": {"name": config_map_name(instance)},
        "data": dict(files),
    }


class Configuration:
    """The files of a template, compiled. Raises InterpolationError, with all further errors in its `others`."""

    def __init__(self, files: Mapping[str, Any], environment: Environment, check: Check) -> None:
        self._files: dict[str, CompiledTemplate] = {}
        errors: list[InterpolationError] = []
        for name, content in sorted(files.items()):
            try:
                self._files[name] = compile_template(content, environment, path=_path(name), check=check)
            except InterpolationError as error:
                errors += [error, *error.others]
        if errors:
            errors[0].others = tuple(errors[1:])
            raise errors[0]

    @property
    def embedded(self) -> tuple[Embedded, ...]:
        """The expressions of all files."""
        return tuple(each for compiled in self._files.values() for each in compiled.embedded)

    def render(self, variables: Mapping[str, Any]) -> tuple[dict[str, str], list[str]]:
        """The text of each file, and the problems, each with its field. A file that is null is left out."""
        files: dict[str, str] = {}
        problems: list[str] = []
        for name, compiled in self._files.items():
            try:
                value = compiled.render(variables, integers=True)
            except InterpolationError as error:
                problems.append(str(error))
                continue
            if value is None:
                continue
            text = _text(name, value)
            if text is None:
                kind = "a map" if isinstance(value, dict) else "a list"
                problems.append(
                    f"{_path(name)}: is {kind}, but the file name gives no format: end the name with .yaml "
                    "or .json, or give a string"
                )
            else:
                files[name] = text
        size = sum(len(name.encode()) + len(text.encode()) for name, text in files.items())
        if size > MAXIMUM_BYTES:
            problems.append(
                f"spec.configuration: the files have {size} bytes together; a ConfigMap can contain at most "
                f"{MAXIMUM_BYTES}: pass a reference to the data instead"
            )
        return files, problems


def _path(name: str) -> str:
    return f"spec.configuration.{name}"


def _text(name: str, value: Any) -> str | None:
    """The file's text; None if its name does not determine a format."""
    if isinstance(value, str):
        return value
    plain = values.normal(value)
    match name.rpartition(".")[2]:
        case "json":
            return json.dumps(plain, ensure_ascii=False, indent=2) + "\n"
        case "yaml" | "yml":
            return to_yaml([plain])
    return None if isinstance(value, dict | list) else values.canonical(value)


def fingerprint(files: Mapping[str, str]) -> str:
    """A short hash of the content of the files."""
    return hashlib.sha256(values.canonical(dict(files)).encode()).hexdigest()[:16]


def selectors(objects: Iterable[Object]) -> tuple[str, ...]:
    """Label selectors that together select the pods of these workloads; an empty one selects all."""
    found = {_selector(each) for each in objects if pod_template(each)}
    return ("",) if "" in found else tuple(sorted(found))


def unannounced_pods(pods: Iterable[Object], instance: str, content: str) -> Iterator[tuple[str, str]]:
    """Name and uid of the pods that mount the instance's configuration, and to which this content was not announced."""
    for pod in pods:
        metadata = pod["metadata"]
        ending = "deletionTimestamp" in metadata or (pod.get("status") or {}).get("phase") in _OVER
        if ending or (metadata.get("annotations") or {}).get(ANNOTATION) == content:
            continue
        if _mounts(pod, config_map_name(instance)):
            yield metadata["name"], metadata["uid"]


def _mounts(pod: Object, config_map: str) -> bool:
    for volume in (pod.get("spec") or {}).get("volumes") or ():
        sources = [volume, *((volume.get("projected") or {}).get("sources") or ())]
        if any((each.get("configMap") or {}).get("name") == config_map for each in sources):
            return True
    return False


def _selector(workload: Object) -> str:
    # The selector never changes. The template's labels may, and older pods keep the old ones.
    labels = (workload["spec"].get("selector") or {}).get("matchLabels")
    labels = labels or (pod_template(workload).get("metadata") or {}).get("labels") or {}
    return ",".join(f"{key}={value}" for key, value in sorted(labels.items()))
