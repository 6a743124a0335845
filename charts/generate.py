"""`python -m charts.generate`: write the generated files of the chart (`make crds` runs it).

`files/crds/` are the CRDs as in crds/; `files/rights.yaml` is the manager's table of rights, from which the chart makes
its roles as `application-manager rbac` does.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from application_manager.core.objects.policy import DEFAULT_KINDS, PLURALS, KindKey, kind_text
from application_manager.core.objects.rights import certificate_rights, lease_rights, merged_rules, node_rights, rights
from wayside.api.__main__ import crd_files
from wayside.manifests import to_yaml

FILES = Path(__file__).parent / "wayside" / "files"
LEASE = "NAME-OF-THE-LEASE"
"""The placeholder for the name of the managers' Lease."""
SECRET_NAME = "NAME-OF-THE-SECRET"  # noqa: S105  the placeholder for a name
WEBHOOKS = "NAME-OF-THE-WEBHOOKS"

_POD = ("v1", "Pod")
_ANY: KindKey = ("example.com/v1", "Example")
_NOTE = "# Written by `make crds` from the manager's table of rights: change that, not this.\n"


def chart_files() -> dict[str, str]:
    """The text of each file, by its path in the chart's folder `files`."""
    return {f"crds/{name}": text for name, text in crd_files().items()} | {"rights.yaml": _NOTE + to_yaml([_rights()])}


def _rights() -> dict[str, Any]:
    """The rules of roles: those that are always needed, and those that each kind and running detectors add."""
    secret, webhooks = certificate_rights(SECRET_NAME, WEBHOOKS)
    without_pods, pods = rights({}), rights({_POD: "pods"})
    return {
        "always": merged_rules(each for each in without_pods if each in pods),
        "withoutPods": merged_rules(each for each in without_pods if each not in pods),
        "detectors": merged_rules(each for each in rights({}, detectors=True) if each not in without_pods),
        "cluster": merged_rules(node_rights()),
        "kinds": {kind_text(kind): _added(kind, plural) for kind, plural in sorted(PLURALS.items())},
        "defaultKinds": sorted(map(kind_text, DEFAULT_KINDS)),
        "otherKindVerbs": _added(_ANY, "examples")[0]["verbs"],
        "lease": merged_rules(lease_rights(LEASE)),
        "secret": merged_rules(secret),
        "webhooks": merged_rules(webhooks),
    }


def _added(kind: KindKey, plural: str) -> list[dict[str, Any]]:
    others = {} if kind == _POD else {_POD: "pods"}
    before = rights(others)
    return merged_rules(each for each in rights(others | {kind: plural}) if each not in before)


def main() -> None:
    """Write the files, and remove the CRDs of former kinds."""
    files = chart_files()
    for old in (FILES / "crds").glob("*.yaml"):
        if f"crds/{old.name}" not in files:
            old.unlink()
    for name, text in files.items():
        path = FILES / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
