"""The chart installed by a real helm into a cluster without any objects of Wayside."""

from __future__ import annotations

import base64
import datetime
import json
import re
import socket
import ssl
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from application_manager.admission.issuer import issued, make_certificates
from tests.cluster.api import Api, ApiError, Object
from tests.cluster.binaries import ensure_binaries
from tests.cluster.controlplane import ControlPlane
from tests.cluster.crds import CRD_NAMES, CRDS, apply_crds, remove_crds, wait_crd_gone
from tests.cluster.manifests import DETECTOR, EVENT_RULE, VALID
from tests.cluster.namespaces import fresh_namespace
from tests.cluster.processes import Processes, environment_of
from tests.cluster.waiting import wait_until
from tests.helm import ensure_tools
from tests.helm.wayside_chart import CHART, Helm, names
from tests.ports import free_ports

RELEASE = "wayside"
PODS_ARE_RESTRICTED = {"pod-security.kubernetes.io/enforce": "restricted"}
UNRESTRICTED: Object = {
    "apiVersion": "v1",
    "kind": "Pod",
    "metadata": {"name": "unrestricted"},
    "spec": {"containers": [{"name": "main", "image": "app:1"}]},
}
ALL: dict[str, Any] = {
    "manager": {"replicas": 2},
    "detectors": [
        {"name": "town", "labels": {"a": "b"}, "service": {"ports": [7447]}, "spec": DETECTOR["spec"]},
    ],
    "eventRules": [{"name": "one", "labels": {"site": "north"}, "spec": EVENT_RULE["spec"]}],
    "router": {
        "enabled": True,
        "tls": {"secretName": "router-tls"},
        "accessControl": {"clients": [{"name": "cars", "commonNames": ["car1"], "publish": ["vehicles/**"]}]},
    },
    "monitoring": {"dashboard": {"enabled": True}},
    "networkPolicy": {"egress": {"restrict": True}},
}


@pytest.fixture(scope="module")
def empty_control_plane() -> Iterator[ControlPlane]:
    """A control plane without the CRDs, which the chart installs."""
    with ControlPlane(ensure_binaries()) as running:
        yield running


@pytest.fixture
def restricted_api(empty_control_plane: ControlPlane, request: pytest.FixtureRequest) -> Iterator[Api]:
    """An administrator's client for a fresh namespace under the restricted Pod Security Standard."""
    with fresh_namespace(empty_control_plane.api(), request.node.name) as name:
        empty_control_plane.api().patch("Namespace", name, {"metadata": {"labels": PODS_ARE_RESTRICTED}})
        api = empty_control_plane.api(name)
        wait_until(lambda: takes(api, UNRESTRICTED), lambda taken: not taken, what="the standard is enforced")
        yield api


def takes(api: Api, manifest: Object) -> bool:
    """Whether the API server would accept the manifest."""
    try:
        api.apply(manifest, dry_run=True)
    except ApiError as error:
        if error.code != 403:
            raise
        return False
    return True


@pytest.fixture
def helm(empty_control_plane: ControlPlane, restricted_api: Api, tmp_path: Any) -> Iterator[Helm]:
    made = Helm(ensure_tools().helm, tmp_path / "home", empty_control_plane.kubeconfig)
    yield made
    made("uninstall", RELEASE, "--namespace", restricted_api.namespace, "--ignore-not-found")
    remove_crds(restricted_api, CRD_NAMES)


def release_objects(api: Api, *kinds: str) -> list[Object]:
    return [each for kind in kinds for each in api.list(kind, labels="app.kubernetes.io/part-of=wayside")]


def install(helm: Helm, api: Api, values: dict[str, Any], verb: str = "install") -> None:
    helm(verb, RELEASE, str(CHART), "--namespace", api.namespace, values=values)


def pods(api: Api, component: str) -> list[Object]:
    return api.list("Pod", labels=f"app.kubernetes.io/component={component}")


def test_an_upgrade_changes_the_objects_and_an_uninstall_removes_all_but_the_crds(
    helm: Helm, restricted_api: Api
) -> None:
    install(helm, restricted_api, ALL)
    for component, count in (("manager", 2), ("router", 1)):
        # The restricted standard is enforced, so only pods that meet it come into being.
        wait_for_pods(restricted_api, component, count)
    town = restricted_api.get("Detector", "town")
    assert town["metadata"]["labels"]["a"] == "b"
    assert town["spec"]["mode"] == "Standalone"
    assert restricted_api.get("EventRule", "one")["spec"]["when"] == EVENT_RULE["spec"]["when"]
    filled = {"data": {"ca.crt": "YQ=="}}  # written by a manager
    restricted_api.patch("Secret", f"{RELEASE}-webhook-certificates", filled)

    install(helm, restricted_api, ALL | {"manager": {"replicas": 1}}, "upgrade")
    kept = restricted_api.get("Secret", f"{RELEASE}-webhook-certificates")["data"]
    assert kept == filled["data"], "an upgrade keeps the certificates"
    assert restricted_api.find("PodDisruptionBudget", f"{RELEASE}-manager") is None
    assert restricted_api.get("Detector", "town")["metadata"]["uid"] == town["metadata"]["uid"], (
        "the Detector is updated, not recreated"
    )
    install(helm, restricted_api, ALL | {"eventRules": []}, "upgrade")
    restricted_api.wait_gone("EventRule", "one")

    helm("uninstall", RELEASE, "--namespace", restricted_api.namespace)
    restricted_api.wait_gone("Detector", "town")
    left = sorted(installed_kinds() - {"CustomResourceDefinition"})
    wait_until(
        lambda: names(release_objects(restricted_api, *left)),
        lambda found: not found,
        what="nothing else of the release is left",
    )
    assert len(release_objects(restricted_api, "CustomResourceDefinition")) == 5
    install(helm, restricted_api, {})  # the next release adopts the kept CRDs


def test_an_uninstall_without_an_earlier_upgrade_removes_all_objects_too(helm: Helm, restricted_api: Api) -> None:
    install(helm, restricted_api, ALL | {"crds": {"keep": True}})
    assert restricted_api.find("EventRule", "one") is not None
    helm("uninstall", RELEASE, "--namespace", restricted_api.namespace)
    restricted_api.wait_gone("EventRule", "one")
    restricted_api.wait_gone("Detector", "town")


def test_an_upgrade_of_the_crds_changes_no_stored_object(helm: Helm, restricted_api: Api, tmp_path: Path) -> None:
    """The same spec gives the same manifests, so no running application is applied again."""
    older = tmp_path / "older"
    older.mkdir()
    for file in CRDS.glob("*.yaml"):
        (older / file.name).write_text(yaml.safe_dump(_without_rules(yaml.safe_load(file.read_text()))))
    assert apply_crds(restricted_api, older) == {}
    stored = {kind: restricted_api.apply(one) for kind, one in VALID.items()}
    assert apply_crds(restricted_api) == {}
    for kind, before in stored.items():
        again = restricted_api.apply(VALID[kind])
        assert again["metadata"]["uid"] == before["metadata"]["uid"]
        assert (kind, again["metadata"]["generation"]) == (kind, before["metadata"]["generation"])
        assert again["spec"] == before["spec"]


def _without_rules(schema: Any) -> Any:
    """A CRD as in an earlier version: without CEL rules, and with a field owner for each key of free-form data."""
    if isinstance(schema, list):
        return [_without_rules(each) for each in schema]
    if not isinstance(schema, dict):
        return schema
    left = ("x-kubernetes-map-type", "x-kubernetes-validations")
    return {key: _without_rules(value) for key, value in schema.items() if key not in left}


def test_crds_that_are_not_kept_are_removed_too(helm: Helm, restricted_api: Api) -> None:
    install(helm, restricted_api, {"crds": {"keep": False}})
    helm("uninstall", RELEASE, "--namespace", restricted_api.namespace)
    for name in CRD_NAMES:
        wait_crd_gone(restricted_api, name)


@pytest.mark.parametrize(
    "values",
    [
        {},
        ALL,
        {"manager": {"namespaces": ["default", "kube-public"], "allowedKinds": ["apps/v1/Deployment"]}},
        {"webhook": {"enabled": False}, "admissionPolicy": {"enabled": False}, "networkPolicy": {"enabled": False}},
        {"router": {"enabled": True, "tls": {"enabled": False}, "accessControl": {"enabled": False}}},
    ],
)
def test_the_api_server_accepts_everything_that_is_rendered(
    helm: Helm, restricted_api: Api, values: dict[str, Any]
) -> None:
    rendered = helm.rendered(values, namespace=restricted_api.namespace).manifests
    for each in rendered:
        if each["apiVersion"] == "wayside.dev/v1alpha1":
            continue  # custom resources are rendered too; the installation tests show that they are accepted
        where = {"namespace": restricted_api.namespace} if not each["metadata"].get("namespace") else {}
        each["metadata"] |= where if each["kind"] not in CLUSTER_WIDE else {}
        restricted_api.apply(each, dry_run=True)


CLUSTER_WIDE = {
    "ClusterRole",
    "ClusterRoleBinding",
    "CustomResourceDefinition",
    "FlowSchema",
    "PriorityLevelConfiguration",
    "ValidatingAdmissionPolicy",
    "ValidatingAdmissionPolicyBinding",
    "ValidatingWebhookConfiguration",
}


def installed_kinds() -> set[str]:
    """The kinds that a release may contain, without those of other programs."""
    return CLUSTER_WIDE | {
        "ConfigMap", "Deployment", "Lease", "NetworkPolicy", "Pod", "PodDisruptionBudget", "Role", "RoleBinding",
        "Secret", "Service", "ServiceAccount",
    }  # fmt: skip


def wait_for_pods(api: Api, component: str, count: int) -> None:
    api.wait_list(
        "Pod",
        lambda found: len(found) == count,
        labels=f"app.kubernetes.io/component={component}",
        what=f"{count} pods of the {component}",
    )


def test_the_installed_rights_suffice_for_the_manager_and_the_test_pod_reaches_it(
    helm: Helm, restricted_api: Api, empty_control_plane: ControlPlane, tmp_path: Path
) -> None:
    mine = {
        "namespaces": [restricted_api.namespace],
        "allowedKinds": ["v1/ConfigMap"],
        "metrics": {"tlsSecretName": "metrics"},
    }
    install(helm, restricted_api, {"manager": mine, "logFormat": "json"})
    container = restricted_api.get("Deployment", f"{RELEASE}-manager")["spec"]["template"]["spec"]["containers"][0]
    metrics, webhook = free_ports(2)
    certificates = tmp_path / "certificates"
    service, hook = f"{RELEASE}-webhook.{restricted_api.namespace}.svc", f"{RELEASE}-{restricted_api.namespace}"
    make_certificates(tmp_path / "metrics", ("127.0.0.1",))
    here = {
        "--metrics-port": str(metrics),
        "--metrics-certificates": str(tmp_path / "metrics"),
        "--admission-port": str(webhook),
        "--admission-certificates": str(certificates),
    }
    options = [word.split("=", 1) for word in container["args"][1:]]
    arguments = [f"{option}={here.get(option, value)}" for option, value in options]
    (logs := tmp_path / "logs").mkdir()
    account = empty_control_plane.kubeconfig_of_service_account(restricted_api.namespace, f"{RELEASE}-manager")
    processes = Processes(logs, environment_of(account))
    try:
        manager = processes.start(*container["command"], container["args"][0], *arguments)
        manager.wait_for_output("active: holds the Lease")  # the Secret of the chart is empty at first
        first = trusted(restricted_api, hook)
        assert shown(webhook, first, service) == (certificates / "tls.crt").read_bytes()
        (pod,) = helm.rendered({"manager": mine}).of("Pod")
        script, *where = pod["spec"]["containers"][0]["args"]
        schemes = [each.partition(":")[0] for each in where]
        assert schemes == ["https", "/metrics-authority/ca.crt", "https", "/authority/ca.crt", restricted_api.namespace]
        where[:2] = [f"https://127.0.0.1:{metrics}", str(tmp_path / "metrics" / "ca.crt")]
        where[2:4] = [f"https://{service}:{webhook}", str(certificates / "ca.crt")]
        done = subprocess.run(
            [sys.executable, "-c", RESOLVING + script, *where], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert "the manager is ready" in done.stdout
        assert "the webhook refuses what is wrong" in done.stdout
        stranger = Api(
            empty_control_plane.kubeconfig_of_service_account(restricted_api.namespace, "default"),
            restricted_api.namespace,
        )
        schemas = {f"{hook}-{what}" for what in ("lease", "manager", "tasks")}

        def served() -> set[str]:
            with pytest.raises(ApiError, match="cannot create resource"):
                stranger.create(TASK)
            return served_by(restricted_api)

        wait_until(served, schemas.__eq__, what="each flow schema has served requests")
        # A certificate about to expire is renewed; the API server trusts both authorities before the new one is served.
        dying = issued((service,), datetime.timedelta(minutes=20))
        data = {name: base64.b64encode(content).decode() for name, content in dying.items()}
        restricted_api.patch("Secret", f"{RELEASE}-webhook-certificates", {"data": data})
        bundle = wait_until(
            lambda: trusted(restricted_api, hook),
            lambda found: found not in (first, b""),
            what="there is a new authority",
        )
        assert dying["ca.crt"] in bundle
        wait_until(
            lambda: shown(webhook, first + bundle, service),
            lambda found: found == (certificates / "tls.crt").read_bytes() and shown(webhook, bundle, service) == found,
            what="the new certificate is served",
        )
        assert manager.terminate() == 0
        assert "service account cannot" not in manager.output()
        for line in manager.output().splitlines():
            assert {"time", "level", "logger", "message"} <= json.loads(line).keys()
    finally:
        processes.kill_all()


def test_the_api_server_accepts_the_test_pod_too(helm: Helm, restricted_api: Api) -> None:
    (pod,) = helm.rendered({}, namespace=restricted_api.namespace).of("Pod")
    created = restricted_api.create(pod)
    assert created["metadata"]["annotations"]["helm.sh/hook"] == "test"
    privileged = pod | {"metadata": {"name": "privileged"}}
    privileged["spec"]["securityContext"] = {}
    with pytest.raises(ApiError, match="violates PodSecurity"):
        restricted_api.create(privileged)


def test_the_default_user_roles_cover_waysides_kinds(helm: Helm, restricted_api: Api) -> None:
    install(helm, restricted_api, {})
    rbac = "rbac.authorization.k8s.io"
    for role in ("view", "edit"):
        subject = {"apiGroup": rbac, "kind": "User", "name": f"with-{role}"}
        reference = {"apiGroup": rbac, "kind": "ClusterRole", "name": role}
        named = {"apiVersion": f"{rbac}/v1", "kind": "RoleBinding", "metadata": {"name": role}}
        restricted_api.apply(named | {"roleRef": reference, "subjects": [subject]})

    def may(role: str, verb: str) -> bool:
        about = {"group": "wayside.dev", "resource": "eventrules", "verb": verb, "namespace": restricted_api.namespace}
        review = {"apiVersion": "authorization.k8s.io/v1", "kind": "SubjectAccessReview", "metadata": {}}
        return bool(
            restricted_api.create(review | {"spec": {"user": f"with-{role}", "resourceAttributes": about}})["status"][
                "allowed"
            ]
        )

    wanted = {"view": ["list"], "edit": ["list", "create", "delete"]}
    verbs = ("list", "create", "delete", "hold")
    wait_until(
        lambda: {role: [verb for verb in verbs if may(role, verb)] for role in wanted},
        lambda found: found == wanted,
        what="the default roles aggregate Wayside's",
    )


TASK: Object = {
    "apiVersion": "wayside.dev/v1alpha1",
    "kind": "ApplicationTask",
    "metadata": {"name": "a"},
    "spec": {"templateName": "a"},
}


def served_by(api: Api) -> set[str]:
    """The chart's flow schemas by which the API server has served requests."""
    found = re.findall(
        r'^apiserver_flowcontrol_dispatched_requests_total\{flow_schema="([^"]*)".* [1-9]',
        api.raw("/metrics"),
        re.MULTILINE,
    )
    return set(found) & {each["metadata"]["name"] for each in release_objects(api, "FlowSchema")}


RESOLVING = """
import socket
_resolve = socket.getaddrinfo
socket.getaddrinfo = lambda host, *rest, **more: _resolve("127.0.0.1", *rest, **more)
"""
"""In place of the cluster's DNS, which resolves the name of the Service."""


def trusted(api: Api, hook: str) -> bytes:
    """The caBundle with which the API server verifies the manager's certificate; empty while the webhooks differ."""
    kinds = ("ValidatingWebhookConfiguration", "MutatingWebhookConfiguration")
    bundles = {each["clientConfig"]["caBundle"] for kind in kinds for each in api.get(kind, hook)["webhooks"]}
    return base64.b64decode(bundles.pop()) if len(bundles) == 1 else b""


def shown(port: int, authorities: bytes, host: str) -> bytes:
    """The certificate that the port serves to a client that trusts these authorities; empty if they did not sign it."""
    context = ssl.create_default_context(cadata=authorities.decode())
    try:
        with (
            socket.create_connection(("127.0.0.1", port)) as plain,
            context.wrap_socket(plain, server_hostname=host) as connection,
        ):
            return ssl.DER_cert_to_PEM_cert(connection.getpeercert(binary_form=True) or b"").encode()
    except ssl.SSLCertVerificationError:
        return b""
