"""A small cluster with the roles and flow schemas of the chart, for a manager and two tenants.

The API server takes as many requests at once as suit two cores: its default of 600 is for a machine with dozens. API
Priority and Fairness shares out this number. The controller manager sends 20 requests a second, as it does by default.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from tests.cluster.api import Api
from tests.cluster.controlplane import ControlPlane
from tests.cluster.controlplane.site import LOOPBACK
from tests.cluster.crds import CRDS
from tests.cluster.waiting import wait_until
from tests.helm import ensure_tools
from tests.helm.wayside_chart import Helm

SYSTEM, QUIET, LOUD, UNSERVED = "system", "quiet", "loud", "unserved"
"""The namespaces of the manager, of the tenant that is measured and of the attacker, and one that the manager does not
serve."""

SITE = replace(
    LOOPBACK,
    api_server=(*LOOPBACK.api_server, "--max-requests-inflight=20", "--max-mutating-requests-inflight=12"),
    controller_manager=("--kube-api-qps=20", "--kube-api-burst=30"),
)
_INSTALLED = (
    "ServiceAccount",
    "ClusterRole",
    "ClusterRoleBinding",
    "Role",
    "RoleBinding",
    "Lease",
    "PriorityLevelConfiguration",
    "FlowSchema",
)
_TENANT = "tenant"
_SERIES = re.compile(
    r"^apiserver_flowcontrol_request_(wait_duration|execution)_seconds_(sum|count)"
    r'\{(?=[^}]*flow_schema="([^"]*)")(?![^}]*type="watch")[^}]*\} (\S+)$',
    re.MULTILINE,
)


@dataclass(frozen=True)
class Cluster:
    """A running one.

    Attributes:
        api: an administrator's.
        manager: the kubeconfig of the manager's account.
        tenants: that of an account with the role `edit` in its namespace, by namespace.
        programs: their process ids.
    """

    api: Api
    manager: Path
    tenants: dict[str, Path]
    programs: dict[str, int]

    def requests(self) -> dict[str, tuple[float, float, float]]:
        """By flow schema: the number of requests, and the seconds that all of them waited for a seat, and had one."""
        found: dict[tuple[str, str, str], float] = {}
        for what, of, schema, value in _SERIES.findall(self.api.raw("/metrics")):
            found[schema, what, of] = found.get((schema, what, of), 0.0) + float(value)
        return {
            schema: (found[schema, "execution", "count"], found[schema, "wait_duration", "sum"], seconds)
            for (schema, what, of), seconds in found.items()
            if (what, of) == ("execution", "sum") and (schema, "wait_duration", "sum") in found
        }


@contextmanager
def small_cluster(folder: Path) -> Iterator[Cluster]:
    """Run one while the block does; `folder` is for helm's home."""
    tools = ensure_tools()
    with ControlPlane(crds=CRDS, site=SITE) as plane:
        api = plane.api()
        for namespace in (SYSTEM, QUIET, LOUD, UNSERVED):
            api.create({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": namespace}})
        values = {"manager": {"grant": [QUIET, LOUD]}, "webhook": {"enabled": False}}
        for manifest in Helm(tools.helm, folder / "home").rendered(values, namespace=SYSTEM).of(*_INSTALLED):
            manifest["metadata"].setdefault("namespace", SYSTEM)
            api.apply(manifest)
        tenants = {namespace: _tenant(plane, namespace) for namespace in (QUIET, LOUD, UNSERVED)}
        manager = plane.kubeconfig_of_service_account(SYSTEM, "wayside-manager")
        yield Cluster(api, manager, tenants, plane.processes)


def _tenant(plane: ControlPlane, namespace: str) -> Path:
    api = plane.api(namespace)
    api.create({"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": _TENANT}})
    api.create(
        {
            "apiVersion": "rbac.authorization.k8s.io/v1",
            "kind": "RoleBinding",
            "metadata": {"name": _TENANT},
            "roleRef": {"apiGroup": "rbac.authorization.k8s.io", "kind": "ClusterRole", "name": "edit"},
            "subjects": [{"kind": "ServiceAccount", "name": _TENANT, "namespace": namespace}],
        }
    )
    kubeconfig = plane.kubeconfig_of_service_account(namespace, _TENANT)
    question = {
        "apiVersion": "authorization.k8s.io/v1",
        "kind": "SelfSubjectAccessReview",
        "metadata": {},
        "spec": {
            "resourceAttributes": {
                "group": "wayside.dev",
                "resource": "applicationtasks",
                "verb": "create",
                "namespace": namespace,
            }
        },
    }
    # The controller manager adds what the chart aggregates to the role `edit`.
    wait_until(
        lambda: Api(kubeconfig, namespace).create(question)["status"]["allowed"],
        bool,
        what=f"the account of namespace {namespace} may create tasks",
    )
    return kubeconfig
