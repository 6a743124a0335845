"""The webhook configurations, by which the API server calls the manager before it stores objects. Pure.

A ValidatingWebhookConfiguration for templates, rules and detectors, and a MutatingWebhookConfiguration for pods that
request a detector. This module makes them safe: failurePolicy Ignore and a short timeout, so that a manager that is
unavailable or hangs delays a change but never prevents it; only new specs of three kinds, and only new pods with the
label; and no side effects, so that a dry run is reviewed as well.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

from application_manager.core.findings.reviews import REVIEWED
from application_manager.core.objects.sidecars import SIDECAR_LABEL
from wayside.api.base import GROUP, VERSION

PATH = "/admission"
INJECTION_PATH = "/injection"
TIMEOUT = 5  # s by which a manager that hangs delays a change
_SERVICE = re.compile(r"(?P<namespace>[a-z0-9-]+)/(?P<name>[a-z0-9-]+)(?::(?P<port>[0-9]{1,5}))?")
_URL = re.compile(r"https://(\[[0-9a-fA-F:]+\]|[^/:?#@\s]+)(:[0-9]{1,5})?")


@dataclass(frozen=True, slots=True)
class WebhookClientConfig:
    """The address of the manager for the API server: a Service, or a URL.

    `client`: the `clientConfig`, without the path and the CA; `hosts`: the names that the manager's certificate must
    have.
    """

    client: dict[str, Any]
    hosts: tuple[str, ...]

    @classmethod
    def of_service(cls, text: str) -> Self:
        """NAMESPACE/NAME[:PORT]. Raises ValueError."""
        found = _SERVICE.fullmatch(text)
        if found is None:
            raise ValueError(f"must be NAMESPACE/NAME or NAMESPACE/NAME:PORT of a Service; got {text!r}")
        namespace, name, port = found["namespace"], found["name"], int(found["port"] or 443)
        client = {"service": {"namespace": namespace, "name": name, "port": port}}
        return cls(client, tuple(f"{name}.{namespace}{end}" for end in (".svc", ".svc.cluster.local", "")))

    @classmethod
    def of_url(cls, text: str) -> Self:
        """https://HOST[:PORT]. Raises ValueError."""
        found = _URL.fullmatch(text.rstrip("/"))
        if found is None:
            raise ValueError(f"must be https://HOST:PORT, without a path; got {text!r}")
        return cls({"url": text.rstrip("/")}, (found[1].strip("[]"),))

    def at(self, path: str, authority: bytes | None) -> dict[str, Any]:
        """The `clientConfig` of a path; `authority`: see `webhook_configuration`."""
        made: dict[str, Any] = (
            {"service": self.client["service"] | {"path": path}}
            if "service" in self.client
            else {"url": f"{self.client['url']}{path}"}
        )
        return made | ({} if authority is None else {"caBundle": base64.b64encode(authority).decode()})


def certificate_secret(service: str) -> tuple[str, str]:
    """Namespace and name of the Secret with the certificate that the manager issues for a Service NAMESPACE/NAME.

    Raises ValueError if `service` is not valid.
    """
    if _SERVICE.fullmatch(service) is None or ":" in service:
        raise ValueError(f"must be NAMESPACE/NAME of a Service; got {service!r}")
    namespace, _, name = service.partition("/")
    return namespace, f"{name}-certificates"


def webhook_configuration(
    place: WebhookClientConfig, authority: bytes | None, namespaces: Sequence[str] = (), name: str = "wayside"
) -> dict[str, Any]:
    """The webhook configuration for templates, rules and detectors; `namespaces` empty: all.

    `authority`: the certificate (PEM) of the CA that signed the manager's; None if another program adds it, such as
    cert-manager.
    """
    rules = _rules(GROUP, VERSION, ["CREATE", "UPDATE"], sorted(REVIEWED.values()))
    webhook = {"name": f"admission.{GROUP}", "clientConfig": place.at(PATH, authority), "rules": rules}
    return _configuration("ValidatingWebhookConfiguration", name, webhook, namespaces)


def injection_configuration(
    place: WebhookClientConfig, authority: bytes | None, namespaces: Sequence[str] = (), name: str = "wayside"
) -> dict[str, Any]:
    """The webhook configuration for pods that request a detector; the arguments are as above."""
    webhook: dict[str, Any] = {
        "name": f"injection.{GROUP}",
        "clientConfig": place.at(INJECTION_PATH, authority),
        "objectSelector": {"matchExpressions": [{"key": SIDECAR_LABEL, "operator": "Exists"}]},
        "rules": _rules("", "v1", ["CREATE"], ["pods"]),
        "reinvocationPolicy": "IfNeeded",  # another webhook may change the volumes or the account
    }
    return _configuration("MutatingWebhookConfiguration", name, webhook, namespaces)


def _rules(group: str, version: str, operations: list[str], resources: list[str]) -> list[dict[str, Any]]:
    return [
        {
            "apiGroups": [group],
            "apiVersions": [version],
            "operations": operations,
            "resources": resources,
            "scope": "Namespaced",
        }
    ]


def _configuration(kind: str, name: str, webhook: dict[str, Any], namespaces: Sequence[str]) -> dict[str, Any]:
    webhook |= {
        "failurePolicy": "Ignore",
        "timeoutSeconds": TIMEOUT,
        "sideEffects": "None",
        "admissionReviewVersions": ["v1"],
    }
    if namespaces:
        named = {"key": "kubernetes.io/metadata.name", "operator": "In", "values": sorted(namespaces)}
        webhook["namespaceSelector"] = {"matchExpressions": [named]}
    return {
        "apiVersion": "admissionregistration.k8s.io/v1",
        "kind": kind,
        "metadata": {"name": name, "labels": {"app.kubernetes.io/part-of": "wayside"}},
        "webhooks": [webhook],
    }
