"""The permissions that the manager's account needs, from the kinds that templates may create. Pure.

One table for three uses: `application-manager rbac` prints it as roles, a starting manager queries the API server for
each of its entries, and the tests compare it with the manager's requests. It contains no verb that is not needed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from application_manager.core.objects.policy import KindKey
from application_manager.core.objects.suspension import SCALED
from wayside.api import API_VERSION
from wayside.kubernetes.leases import lease_name

_GROUP = API_VERSION.partition("/")[0]
_LEASES = "coordination.k8s.io"
_RBAC = "rbac.authorization.k8s.io"
_LISTING = ("list", "watch")
_READING = frozenset({"get", *_LISTING})
_REPORTED_BY_EVENTS = frozenset({("apps/v1", "StatefulSet"), ("apps/v1", "DaemonSet"), ("batch/v1", "Job")})
"""The kinds whose status does not show that their pods are refused (core/health/refusals.py)."""


@dataclass(frozen=True, slots=True)
class PolicyRule:
    """Verbs on a resource.

    Attributes:
        group: the API group, empty for the core group.
        resource: the plural, with `/<subresource>` where it is one.
        purpose: the consequence if it is missing; `vital`: the manager, or the detector, cannot work without it.
        name: the one object that it is limited to; empty: all.
    """

    group: str
    resource: str
    verbs: tuple[str, ...]
    purpose: str
    vital: bool = False
    name: str = ""

    def rule(self) -> dict[str, Any]:
        """The rule for a role."""
        names = {"resourceNames": [self.name]} if self.name else {}
        return {"apiGroups": [self.group], "resources": [self.resource], "verbs": list(self.verbs)} | names

    def missing_message(self, verb: str, where: str) -> str:
        """The message if the verb is missing; `where` is "in namespace x" or "in all namespaces"."""
        of = f" of {self.group}" if self.group else ""
        name = f" {self.name}" if self.name else ""
        return f"its service account cannot {verb} {self.resource}{name}{of} {where}, so {self.purpose}"


REMEDY = "apply the output of `application-manager rbac`"


def rights(plurals: Mapping[KindKey, str], *, detectors: bool = False) -> list[PolicyRule]:
    """The permissions in each managed namespace; `detectors`: whether the manager runs detectors."""
    return [*_own(), *_children(plurals), *(_running_detectors() if detectors else ())]


def read_only(needed: Iterable[PolicyRule]) -> list[PolicyRule]:
    """The read permissions, which a manager of all namespaces has in each of them."""
    return _narrowed(needed, lambda verb: verb in _READING)


def writing(needed: Iterable[PolicyRule]) -> list[PolicyRule]:
    """The permissions to write, or to pass on to detectors: they are granted by namespace."""
    return _narrowed(needed, lambda verb: verb not in _READING)


def granting() -> PolicyRule:
    """The permission that a manager of all namespaces queries to learn whether it may write in a namespace."""
    return PolicyRule(_GROUP, "applicationtasks/status", ("patch",), "their statuses are not written")


def _narrowed(needed: Iterable[PolicyRule], keep: Callable[[str], bool]) -> list[PolicyRule]:
    narrowed = [replace(each, verbs=tuple(filter(keep, each.verbs))) for each in needed]
    return [each for each in narrowed if each.verbs]


def detector_rights(name: str) -> list[PolicyRule]:
    """The permissions of a Standalone detector in its namespace."""
    return [
        *_detecting(name, "hold"),
        PolicyRule(_LEASES, "leases", ("get", "update"), "it counts as lost", vital=True, name=lease_name(name)),
        PolicyRule(_LEASES, "leases", ("create",), "it counts as lost", vital=True),
    ]


def sidecar_rights(name: str) -> list[PolicyRule]:
    """The permissions of a Sidecar detector in its namespace.

    Each pod has its own Lease, whose name no role can know: with the verb `hold-as-pod`, the chart's policy makes sure
    that a pod changes no other Lease.
    """
    return [
        *_detecting(name, "hold-as-pod"),
        PolicyRule(_LEASES, "leases", ("get", "update", "create"), "it counts as lost", vital=True),
    ]


def _detecting(name: str, hold: str) -> Iterator[PolicyRule]:
    tasks = ("get", "list", "watch", "create", "patch", "delete")
    yield PolicyRule(_GROUP, "detectors", _LISTING, "it does not know its configuration", vital=True, name=name)
    yield PolicyRule(_GROUP, "detectors", (hold,), "the chart's policy refuses its tasks and its Lease", name=name)
    yield PolicyRule(_GROUP, "eventrules", _LISTING, "it does not know its rules", vital=True)
    yield PolicyRule(_GROUP, "applicationtasks", tasks, "it creates no tasks", vital=True)


def lease_rights(name: str) -> list[PolicyRule]:
    """The permissions in the namespace of the managers' own Lease."""
    purpose = "no manager becomes active"
    return [
        PolicyRule(_LEASES, "leases", ("get", "update"), purpose, vital=True, name=name),
        PolicyRule(
            _LEASES, "leases", ("create",), purpose, vital=True
        ),  # no role can know the name of an object that does not exist yet
    ]


def certificate_rights(secret: str, webhooks: str) -> tuple[list[PolicyRule], list[PolicyRule]]:
    """The permissions to issue the webhook's certificate: in the Secret's namespace, and in the cluster."""
    purpose = "the webhook has no certificate that the API server trusts"
    group = "admissionregistration.k8s.io"
    plurals = ("validatingwebhookconfigurations", "mutatingwebhookconfigurations")
    return (
        [PolicyRule("", "secrets", ("get", "update"), purpose, vital=True, name=secret)],
        [PolicyRule(group, each, ("get", "patch"), purpose, vital=True, name=webhooks) for each in plurals],
    )


def node_rights() -> list[PolicyRule]:
    """The optional cluster-wide permissions: nodes belong to no namespace."""
    return [PolicyRule("", "nodes", ("list",), "only the scheduler reports that no node fits a template")]


def _own() -> Iterator[PolicyRule]:
    yield PolicyRule(_GROUP, "applicationtemplates", ("get", *_LISTING), "no task is processed", vital=True)
    instances = ("get", *_LISTING, "create", "patch", "delete")
    yield PolicyRule(
        _GROUP, "applicationinstances", instances, "no instance is created, changed or released", vital=True
    )
    yield PolicyRule(_GROUP, "applicationtasks", _LISTING, "no task is processed", vital=True)
    yield PolicyRule(_GROUP, "applicationtasks", ("delete",), "finished tasks are never deleted")
    yield PolicyRule(_GROUP, "detectors", _LISTING, "rules and detectors have no status", vital=True)
    yield PolicyRule(_GROUP, "eventrules", _LISTING, "rules and detectors have no status", vital=True)
    for plural in ("applicationinstances", "applicationtasks", "applicationtemplates", "detectors", "eventrules"):
        yield PolicyRule(_GROUP, f"{plural}/status", ("patch",), "their statuses are not written")
    yield PolicyRule(_LEASES, "leases", ("get", *_LISTING), "lost holders are not detected", vital=True)
    yield PolicyRule("events.k8s.io", "events", ("create", "patch"), "no Kubernetes Events are posted")


def _running_detectors() -> Iterator[PolicyRule]:
    """To create a detector's objects; the manager must have the permissions in their Roles itself (no `escalate`)."""
    no_detector = "no detector runs"
    for group, resource in (
        ("", "serviceaccounts"),
        (_RBAC, "roles"),
        (_RBAC, "rolebindings"),
        ("apps", "deployments"),
    ):
        yield PolicyRule(group, resource, ("get", "list", "create", "patch", "delete"), no_detector)
    yield PolicyRule("", "pods", ("list",), "statuses do not report why a detector does not run")
    for each in (*detector_rights(""), *sidecar_rights("")):
        yield PolicyRule(each.group, each.resource, each.verbs, no_detector)


def _children(plurals: Mapping[KindKey, str]) -> Iterator[PolicyRule]:
    all_verbs = ("get", *_LISTING, "create", "patch", "delete")
    for (api_version, kind), plural in sorted(plurals.items()):
        group = api_version.rpartition("/")[0]
        yield PolicyRule(group, plural, _LISTING, f"the status of each {kind} is unknown", vital=True)
        others = tuple(verb for verb in all_verbs if verb not in _LISTING)
        yield PolicyRule(group, plural, others, f"no {kind} of a template is created, changed or deleted")
        if (api_version, kind) in SCALED:
            yield PolicyRule(group, f"{plural}/scale", ("patch",), f"no {kind} is suspended or resumed")
    if _REPORTED_BY_EVENTS & plurals.keys():
        yield PolicyRule(
            "events.k8s.io",
            "events",
            ("list",),
            "statuses do not report why pods of workloads other than Deployments are refused",
        )
    if ("v1", "Pod") not in plurals:
        yield PolicyRule("", "pods", _LISTING, "statuses do not report why workloads do not run", vital=True)
        yield PolicyRule("", "pods", ("patch",), "running applications get a changed configuration late")


def roles(
    plurals: Mapping[KindKey, str],
    namespaces: Iterable[str],
    lease: tuple[str, str],
    account: tuple[str, str],
    name: str = "wayside-application-manager",
    *,
    detectors: bool = False,
    granted: Iterable[str] = (),
    certificates: tuple[tuple[str, str], str] | None = None,
) -> list[dict[str, Any]]:
    """The roles and their bindings, as manifests.

    A manager of named namespaces has a Role in each. A manager of all namespaces has a ClusterRole for reading, and
    another one for writing, which only RoleBindings refer to.

    Args:
        plurals: of the allowed kinds.
        namespaces: the managed ones; empty: all.
        lease, account: namespace and name.
        name: of all roles and bindings; those of the Lease end with `-lease`, of the webhook's certificate with
            `-certificates`, the ClusterRole for writing with `-writer`.
        granted: without `namespaces`: the namespaces in which the manager may write.
        certificates: namespace and name of the Secret, and the name of the webhook configurations, if the manager
            issues its webhook's certificate.
    """
    where = list(dict.fromkeys(namespaces))
    needed = rights(plurals, detectors=detectors)
    found: list[dict[str, Any]] = []
    for namespace in where:
        found += bound(name, namespace, merged_rules(needed), account)
    if not where:
        found += bound(name, None, merged_rules([*read_only(needed), *node_rights()]), account)
        found.append(_role(f"{name}-writer", None, merged_rules(writing(needed))))
        found += [_binding(name, each, ("ClusterRole", f"{name}-writer"), account) for each in dict.fromkeys(granted)]
    if certificates is not None:
        (namespace, secret), webhooks = certificates
        there, everywhere = certificate_rights(secret, webhooks)
        found += bound(f"{name}-certificates", namespace, merged_rules(there), account)
        found += bound(f"{name}-certificates", None, merged_rules(everywhere), account)
    return [*found, *bound(f"{name}-lease", lease[0], merged_rules(lease_rights(lease[1])), account)]


def merged_rules(needed: Iterable[PolicyRule]) -> list[dict[str, Any]]:
    """The minimum number of rules: resources of a group with the same verbs are combined."""
    verbs: dict[tuple[str, str, str], dict[str, None]] = {}
    for each in needed:
        verbs.setdefault((each.group, each.name, each.resource), {}).update(dict.fromkeys(each.verbs))
    alike: dict[tuple[str, str, frozenset[str]], PolicyRule] = {}
    resources: dict[tuple[str, str, frozenset[str]], list[str]] = {}
    for (group, only, resource), its in verbs.items():
        key = (group, only, frozenset(its))
        alike.setdefault(key, PolicyRule(group, resource, tuple(its), "", name=only))
        resources.setdefault(key, []).append(resource)
    return [each.rule() | {"resources": resources[key]} for key, each in alike.items()]


def bound(
    name: str, namespace: str | None, rules: list[dict[str, Any]], *accounts: tuple[str, str]
) -> Iterator[dict[str, Any]]:
    """A role with these rules, and its binding for the accounts, each a namespace and a name.

    Both are for the namespace or, without one, for the cluster.
    """
    role = _role(name, namespace, rules)
    yield role
    yield _binding(name, namespace, (role["kind"], name), *accounts)


def _role(name: str, namespace: str | None, rules: list[dict[str, Any]]) -> dict[str, Any]:
    return _object("Role", name, namespace) | {"rules": rules}


def _binding(name: str, namespace: str | None, role: tuple[str, str], *accounts: tuple[str, str]) -> dict[str, Any]:
    """`role`: kind and name; `accounts`: namespace and name of each."""
    return _object("RoleBinding", name, namespace) | {
        "roleRef": {"apiGroup": _RBAC, "kind": role[0], "name": role[1]},
        "subjects": [{"kind": "ServiceAccount", "namespace": each[0], "name": each[1]} for each in accounts],
    }


def _object(kind: str, name: str, namespace: str | None) -> dict[str, Any]:
    where = {"namespace": namespace} if namespace else {}
    kind = kind if namespace else f"Cluster{kind}"
    return {"apiVersion": f"{_RBAC}/v1", "kind": kind, "metadata": {"name": name} | where}
