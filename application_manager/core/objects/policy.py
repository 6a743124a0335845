"""The administrator's limits on kinds, namespaces and service accounts of a template's objects.

The namespace is the boundary: a template's objects are in its own namespace, are of the allowed kinds and use the
allowed service accounts. Any pod may use the service account `default`, so its token is never mounted.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Self

from application_manager.core.objects.podspecs import NamedAccount, PodSpec, pods_and_accounts

KindKey = tuple[str, str]
"""apiVersion and kind."""

Name = tuple[str, str]
"""Namespace and name."""

SECRET: KindKey = ("v1", "Secret")

PLURALS: Mapping[KindKey, str] = {
    ("apps/v1", "DaemonSet"): "daemonsets",
    ("apps/v1", "Deployment"): "deployments",
    ("apps/v1", "StatefulSet"): "statefulsets",
    ("autoscaling/v2", "HorizontalPodAutoscaler"): "horizontalpodautoscalers",
    ("batch/v1", "CronJob"): "cronjobs",
    ("batch/v1", "Job"): "jobs",
    ("networking.k8s.io/v1", "Ingress"): "ingresses",
    ("networking.k8s.io/v1", "NetworkPolicy"): "networkpolicies",
    ("policy/v1", "PodDisruptionBudget"): "poddisruptionbudgets",
    ("v1", "ConfigMap"): "configmaps",
    ("v1", "PersistentVolumeClaim"): "persistentvolumeclaims",
    ("v1", "Pod"): "pods",
    SECRET: "secrets",
    ("v1", "Service"): "services",
}
"""The kinds that are known without a cluster, with their plurals."""

DEFAULT_KINDS: frozenset[KindKey] = frozenset(PLURALS) - {SECRET}
"""The kinds that are allowed by default."""

_NEVER_KINDS = frozenset({"Role", "RoleBinding", "ClusterRole", "ClusterRoleBinding", "ServiceAccount", "Namespace"})
_NEVER_GROUPS = frozenset(
    {
        "admissionregistration.k8s.io",
        "apiextensions.k8s.io",
        "apiregistration.k8s.io",
        "rbac.authorization.k8s.io",
        "wayside.dev",
    }
)

_TOKEN_SECRET = "kubernetes.io/service-account-token"  # noqa: S105  a type of Secret, not one


def kind_text(key: KindKey) -> str:
    """A kind in options and messages, e.g. apps/v1/Deployment."""
    return "/".join(key)


@dataclass(frozen=True, slots=True)
class Policy:
    """The kinds and service accounts that templates may use. Raises ValueError for a kind that can never be allowed."""

    kinds: frozenset[KindKey] = DEFAULT_KINDS
    service_accounts: frozenset[str] = frozenset({"default"})

    def __post_init__(self) -> None:
        for api_version, kind in sorted(self.kinds):
            if kind in _NEVER_KINDS or api_version.partition("/")[0] in _NEVER_GROUPS:
                raise ValueError(
                    f"{api_version}/{kind} can never be allowed: it could give a template permissions beyond its "
                    "namespace"
                )

    @classmethod
    def parse(cls, kinds: list[str] | None, service_accounts: list[str] | None) -> Self:
        """The policy of the options `--allowed-kinds` and `--service-accounts`, None or empty if not given.

        Raises ValueError for an invalid kind, or one that can never be allowed.
        """
        parsed = frozenset(_parse_kind(each) for each in kinds) if kinds else DEFAULT_KINDS
        return cls(parsed, frozenset(service_accounts or ["default"]))

    def check_everywhere(self) -> None:
        """Raise ValueError if a manager of all namespaces may not use one of the kinds."""
        if SECRET in self.kinds:
            raise ValueError(
                "v1/Secret needs --namespace, since a manager of all namespaces would read every Secret of the "
                "cluster: set --namespace, or remove the kind"
            )

    def kind_problem(self, api_version: str, kind: str) -> str | None:
        """Why the kind is not allowed, or None if it is."""
        if (api_version, kind) in self.kinds:
            return None
        same = sorted(kind_text(key) for key in self.kinds if key[1] == kind)
        choice = (
            f"write {' or '.join(same)}"
            if same
            else f"the allowed kinds are {', '.join(sorted(map(kind_text, self.kinds)))}"
        )
        return f"{kind_text((api_version, kind))} is not a kind that the administrator allows: {choice}"

    def pod_problems(self, manifest: dict[str, Any]) -> Iterator[tuple[str, str]]:
        """Field and problem of each part of the manifest's pods that is not allowed."""
        if manifest.get("kind") == "Secret" and manifest.get("type") == _TOKEN_SECRET:
            yield "type", f"{_TOKEN_SECRET} would contain a service account's token: remove it"
        for found in pods_and_accounts(manifest):
            if isinstance(found, NamedAccount):
                yield from self._account_problems(found.where, found.account)
                continue
            spec, where = found.spec, found.where
            account = spec.get("serviceAccountName", spec.get("serviceAccount", "default"))
            refused = list(self._account_problems(f"{where}.serviceAccountName", account))
            yield from refused
            if not refused and account == "default":
                yield from _token_problems(spec, where)

    def _account_problems(self, where: str, account: Any) -> Iterator[tuple[str, str]]:
        if account not in self.service_accounts:
            listed = ", ".join(sorted(self.service_accounts))
            yield (
                where,
                f"{account!r} is not a service account that the administrator allows: use one of {listed}",
            )

    def completed(self, manifest: dict[str, Any]) -> dict[str, Any]:
        """The manifest, changed in place so that its pods do not mount the token of the service account `default`."""
        for found in pods_and_accounts(manifest):
            if isinstance(found, PodSpec) and found.spec.get("serviceAccountName", "default") == "default":
                found.spec.setdefault("automountServiceAccountToken", False)
        return manifest


def _parse_kind(text: str) -> KindKey:
    api_version, slash, kind = text.rpartition("/")
    if not slash or not api_version or not kind[:1].isupper():
        raise ValueError(f"must be apiVersion/Kind, e.g. apps/v1/Deployment or v1/Service; got {text!r}")
    return api_version, kind


def _token_problems(spec: dict[str, Any], where: str) -> Iterator[tuple[str, str]]:
    remedy = "remove it, or use a service account that the administrator allows"
    if spec.get("automountServiceAccountToken"):
        yield (
            f"{where}.automountServiceAccountToken",
            f"true would mount the token of the service account default: {remedy}",
        )
    volumes = spec.get("volumes")
    for index, volume in enumerate(volumes if isinstance(volumes, list) else []):
        projected = volume.get("projected") if isinstance(volume, dict) else None
        sources = projected.get("sources") if isinstance(projected, dict) else None
        for number, source in enumerate(sources if isinstance(sources, list) else []):
            if isinstance(source, dict) and "serviceAccountToken" in source:
                field = f"{where}.volumes[{index}].projected.sources[{number}].serviceAccountToken"
                yield field, f"would mount the token of the service account default: {remedy}"
