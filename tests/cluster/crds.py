"""Installing Wayside's CRDs, and knowing that they serve."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import yaml

from tests.cluster.api import Api, ApiError, Object
from tests.cluster.waiting import PATIENCE, wait_until

CRDS = Path(__file__).parents[2] / "crds"


def apply_crds(api: Api, folder: Path = CRDS, timeout: float = PATIENCE) -> Mapping[str, ApiError]:
    """Apply each CRD in the folder's YAML files and wait until it is served; return the refusals by file name.

    One that is refused holds up no other: its own test fails, and those that need its kind, but not all.

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
    # Established comes a moment before the API server really serves the kind, of which discovery is the witness.
    kinds = {str(crd["spec"]["names"]["kind"]) for crd in accepted}
    wait_until(
        lambda: sorted(kinds - api.discover()), lambda rest: not rest, timeout=timeout, what=f"{kinds} are served"
    )
    return refused


def is_established(crd: Object) -> bool:
    """Whether the API server accepted the names and the schema, and serves the kind."""
    conditions = {each["type"]: each["status"] for each in (crd.get("status") or {}).get("conditions") or []}
    return conditions.get("Established") == "True" and conditions.get("NamesAccepted") == "True"
