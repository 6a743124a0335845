"""Installs Wayside's CRDs and waits until they are served."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

import yaml

from tests.cluster.api import Api, ApiError, Object, Unreachable
from tests.cluster.waiting import wait_until
from tests.patience import PATIENCE

CRDS = Path(__file__).parents[2] / "crds"
CRD_NAMES = frozenset(
    f"{plural}.wayside.dev"
    for plural in ("applicationinstances", "applicationtasks", "applicationtemplates", "detectors", "eventrules")
)
_TOUCH_EVERY = 2.0  # s


def apply_crds(api: Api, folder: Path = CRDS, timeout: float = PATIENCE) -> Mapping[str, ApiError]:
    """Apply each CRD in the folder's YAML files and wait until it is served; return the refusals by file name.

    A rejected CRD does not block the others: only its own test and the tests that need its kind fail.

    Raises:
        TimeoutError: an accepted one is not served after `timeout` seconds.
    """
    accepted: list[Object] = []
    refused: dict[str, ApiError] = {}
    for file in sorted(folder.glob("*.yaml")):
        for manifest in yaml.safe_load_all(file.read_text()):
            try:
                accepted.append(api.apply(manifest))
            except ApiError as error:
                refused[file.name] = error
    for crd in accepted:
        name = str(crd["metadata"]["name"])
        api.wait_for("CustomResourceDefinition", name, is_established, timeout=timeout, what=f"{name} is established")
    # Established is set a moment before the API server really serves the kind; discovery shows when it does.
    kinds = {str(crd["spec"]["names"]["kind"]) for crd in accepted}
    wait_until(
        lambda: sorted(kinds - api.discover()), lambda rest: not rest, timeout=timeout, what=f"{kinds} are served"
    )
    return refused


def wait_garbage_collected(api: Api, timeout: float = 2 * PATIENCE) -> None:
    """Wait until Kubernetes' garbage collector watches Wayside's kinds. Raises TimeoutError.

    It looks for new kinds every 30 s. Only for kinds that it watches does it remove the finalizer of a foreground
    deletion. If the CRDs are deleted earlier, it may keep the dependents of their objects until the next installation.
    """
    name = "garbage-collector-probe"
    config_map = {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": name}}
    template = {"kind": "ApplicationTemplate", "metadata": {"name": name}, "spec": {"manifests": [config_map]}}
    api.create({"apiVersion": "wayside.dev/v1alpha1", **template})
    api.delete("ApplicationTemplate", name, propagation="Foreground")
    wait_until(
        lambda: api.find("ApplicationTemplate", name),
        lambda found: found is None,
        timeout=timeout,
        what="the garbage collector watches Wayside's kinds",
    )


def remove_crds(api: Api, names: Iterable[str], timeout: float = 2 * PATIENCE) -> None:
    """Delete the existing ones of the CRDs and wait until all are removed. Raises TimeoutError."""
    names = list(names)
    for name in names:
        if api.find("CustomResourceDefinition", name) is not None:
            api.delete("CustomResourceDefinition", name)
    for name in names:
        wait_crd_gone(api, name, timeout)


def wait_crd_gone(api: Api, name: str, timeout: float = 2 * PATIENCE) -> None:
    """Wait until a CRD that is being deleted is removed. Raises TimeoutError.

    For a CRD that was just created or changed, the API server finds that its "storage is (re)initializing". It retries
    when the CRD changes, otherwise only minutes later. So this function changes the CRD.
    """
    touched = time.monotonic()

    def look() -> Object | None:
        nonlocal touched
        found = api.find("CustomResourceDefinition", name)
        if found is not None and time.monotonic() - touched > _TOUCH_EVERY:
            touched = time.monotonic()
            with suppress(ApiError):  # it was removed just now
                api.patch("CustomResourceDefinition", name, {"metadata": {"annotations": {"touched": str(touched)}}})
        return found

    wait_until(look, lambda found: found is None, timeout=timeout, what=f"{name} is gone", transient=(Unreachable,))


def is_established(crd: Object) -> bool:
    """Whether the API server accepted the names and the schema, and serves the kind."""
    conditions = {each["type"]: each["status"] for each in (crd.get("status") or {}).get("conditions") or []}
    return conditions.get("Established") == "True" and conditions.get("NamesAccepted") == "True"
