"""`application-manager inject`: injects detectors into manifests, as the webhook does into pods."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import typer
import yaml

from application_manager.cache.cluster_cache import DETECTOR, DETECTORS
from application_manager.cluster.client import manager_client
from application_manager.core.findings.injections import detector_of, injection
from application_manager.core.objects.poddefaults import PodDefaults
from application_manager.core.objects.podspecs import POD_TEMPLATES, pod_template, with_pod_template
from application_manager.core.objects.sidecars import added, has_sidecar
from wayside.api import Detector
from wayside.api.documents import parse_object
from wayside.kubernetes.connection import ConfigurationError, load_configuration
from wayside.kubernetes.errors import RequestError
from wayside.manifests import to_yaml
from wayside.process import commandline

_NO_IMAGE = "Detector {} has no image: give --detector-image, or set its spec.pod.image"

Manifest = dict[str, Any]


def print_injected(files: Sequence[str], namespace: str, detector_image: str | None) -> None:
    """Print the manifests with their detectors as YAML; exits with 1 if a pod cannot have its detector.

    `files` contain manifests and Detectors, `-` is stdin; `namespace` is for manifests, and `detector_image` for
    Detectors, that have none. Raises ConfigurationError if a file or a Detector cannot be read.
    """
    documents = [each for file in files for each in _read(file)]
    from_files = {each.name: each for each in map(_detector, documents) if each is not None}
    requested = {each for raw in documents for each in _requested(raw, namespace) if each[1] not in from_files}
    found = asyncio.run(_looked_up(requested)) if requested else {}
    injector = _Injector(from_files, found, namespace, detector_image)
    sys.stdout.write(to_yaml([injector.manifest(each) for each in documents if not _is_detector(each)]))
    for line in injector.refusals:
        typer.echo(line, err=True)
    if injector.refusals:
        raise typer.Exit(1)


@dataclass(slots=True)
class _Injector:
    """Injects Detectors: those of the files by name, and those of the cluster by namespace and name."""

    from_files: dict[str, Detector]
    from_cluster: dict[tuple[str, str], Detector]
    namespace: str
    image: str | None
    refusals: list[str] = field(default_factory=list)

    def manifest(self, raw: Manifest) -> Manifest:
        """The manifest with its detector, if it requests one."""
        if raw.get("kind") == "List":
            return raw | {"items": [self.manifest(each) for each in raw.get("items") or ()]}
        return with_pod_template(raw, lambda pod: self._pod(raw, pod))

    def _pod(self, raw: Manifest, pod: Manifest) -> Manifest:
        name = detector_of(pod.get("metadata"))
        spec = pod.get("spec") or {}
        if name is None or has_sidecar(spec):
            return pod
        namespace = _namespace(raw, self.namespace)
        detector = self.from_files.get(name) or self.from_cluster.get((namespace, name))
        image = self.image
        if detector is not None and image is None:
            image = detector.spec.pod.image if detector.spec.pod is not None else None
            if image is None:
                raise ConfigurationError(_NO_IMAGE.format(name))
        found = injection(pod["metadata"], spec, namespace, detector, PodDefaults(image or ""))
        if found.why_not is not None:
            self.refusals.append(f"{raw['kind']} {(raw.get('metadata') or {}).get('name', '')}: {found.why_not}")
        return pod if found.addition is None else pod | {"spec": added(spec, found.addition)}


async def _looked_up(requested: set[tuple[str, str]]) -> dict[tuple[str, str], Detector]:
    """Read the Detectors that the files do not contain from the cluster. Raises ConfigurationError."""
    listed = ", ".join(sorted(name for _, name in requested))
    otherwise = "give its file with -f, or use the kubeconfig of a cluster that has it"
    try:
        client = manager_client(await load_configuration())
    except ConfigurationError as error:
        raise ConfigurationError(
            f"Detector {listed} is in none of the files, and cannot be read from the cluster: {error}: {otherwise}"
        ) from error
    try:
        raws = {each: await client.get(DETECTORS, *each) for each in sorted(requested)}
    except RequestError as error:
        raise ConfigurationError(f"Detector {listed} cannot be read from the cluster: {error}: {otherwise}") from error
    finally:
        await client.close()
    return {each: found for each, raw in raws.items() if raw is not None and (found := _detector(raw)) is not None}


def _requested(raw: Manifest, default: str) -> Iterator[tuple[str, str]]:
    """The namespaces and names of the Detectors that the manifest requests and does not contain yet."""
    if raw.get("kind") == "List":
        for each in raw.get("items") or ():
            yield from _requested(each, default)
        return
    pod = pod_template(raw) if raw.get("kind") in POD_TEMPLATES else {}
    name = detector_of(pod.get("metadata"))
    if name is not None and not has_sidecar(pod.get("spec") or {}):
        yield _namespace(raw, default), name


def _namespace(raw: Mapping[str, Any], default: str) -> str:
    return str((raw.get("metadata") or {}).get("namespace") or default)


def _is_detector(raw: Mapping[str, Any]) -> bool:
    return (raw.get("apiVersion"), raw.get("kind")) == DETECTOR


def _detector(raw: Manifest) -> Detector | None:
    """The Detector; None for another kind. Raises ConfigurationError if it is not valid."""
    if not _is_detector(raw):
        return None
    try:
        found = parse_object(raw)
    except ValueError as error:
        name = (raw.get("metadata") or {}).get("name", "")
        raise ConfigurationError(f"Detector {name}: {error}") from error
    return found if isinstance(found, Detector) else None


def _read(file: str) -> list[Manifest]:
    """The documents of a file. Raises ConfigurationError."""
    try:
        text = sys.stdin.read() if file == "-" else Path(file).read_text(encoding="utf-8")
        documents = [each for each in yaml.safe_load_all(text) if each is not None]
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "is not UTF-8 text"
        raise ConfigurationError(f"-f {file}: {reason}: give a readable YAML file, or - for stdin") from error
    except yaml.YAMLError as error:
        raise ConfigurationError(f"-f {file}: is not YAML: {' '.join(str(error).split())}") from error
    for each in documents:
        if not isinstance(each, dict) or not isinstance(each.get("kind"), str):
            commandline.refuse(f"-f {file}: contains a document that is not a manifest: each needs apiVersion and kind")
    return documents
