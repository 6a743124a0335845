"""The roles and webhooks that the chart renders are those that the manager prints."""

from __future__ import annotations

from typing import Any

import pytest
import yaml

from tests import programs
from tests.helm import ensure_tools
from tests.helm.wayside_chart import Helm, HelmError, Rendered

Object = dict[str, Any]


@pytest.fixture(scope="module")
def helm(tmp_path_factory: pytest.TempPathFactory) -> Helm:
    return Helm(ensure_tools().helm, tmp_path_factory.mktemp("helm") / "home")


def printed(command: str, *arguments: str) -> list[Object]:
    environment = {"KUBECONFIG": "/nonexistent"}
    done = programs.run("application-manager", command, *arguments, check=True, environment=environment)
    return list(yaml.safe_load_all(done.stdout))


def granted(manifests: list[Object]) -> dict[tuple[str, str, str], set[tuple[str, str, str, str]]]:
    """Kind, namespace and name of each role: group, resource, verb and the name that it is limited to."""
    return {
        (each["kind"], each["metadata"].get("namespace", ""), each["metadata"]["name"]): {
            (group, resource, verb, name)
            for rule in each["rules"]
            for group in rule["apiGroups"]
            for resource in rule["resources"]
            for verb in rule["verbs"]
            for name in rule.get("resourceNames", [""])
        }
        for each in manifests
        if "rules" in each and each["kind"] in ("Role", "ClusterRole")
    }


def bound(manifests: list[Object]) -> list[tuple[Any, ...]]:
    """Kind, namespace, role and subjects of each binding."""
    return sorted(
        (
            each["kind"],
            each["metadata"].get("namespace", ""),
            each["roleRef"]["kind"],
            each["roleRef"]["name"],
            str(sorted(sorted(subject.items()) for subject in each["subjects"])),
        )
        for each in manifests
        if each["kind"] in ("RoleBinding", "ClusterRoleBinding")
    )


@pytest.mark.parametrize(
    ("namespaces", "grant", "kinds", "detectors"),
    [
        ([], [], [], True),
        ([], ["north", "south"], ["v1/Pod"], False),
        (["north"], [], ["v1/ConfigMap", "v1/Pod"], False),
        (["north", "south"], [], ["v1/Service", "v1/Secret", "apps/v1/StatefulSet"], True),
    ],
)
def test_the_charts_roles_are_those_that_the_manager_prints(
    helm: Helm, namespaces: list[str], grant: list[str], kinds: list[str], detectors: bool
) -> None:
    manager = {"namespaces": namespaces, "grant": grant, "allowedKinds": kinds, "detectors": {"run": detectors}}
    rendered = helm.rendered({"manager": manager, "userRoles": {"create": False}})
    options = ["--account", "town/wayside-manager", "--name", "wayside-manager", *(["--detectors"] * detectors)]
    options += [word for each in kinds for word in ("--allowed-kinds", each)]
    options += [word for each in namespaces for word in ("--namespace", each)]
    options += ["--admission-service", "town/wayside-webhook", "--admission-webhooks", "wayside-town"]
    options += [word for each in grant or ["town"] * (not namespaces) for word in ("--grant", each)]
    wanted = printed("rbac", *options)
    assert granted(rendered.manifests) == granted(wanted)
    assert bound(rendered.manifests) == bound(wanted)
    args = rendered.one("Deployment", "wayside-manager")["spec"]["template"]["spec"]["containers"][0]["args"]
    assert [f"--namespace={each}" for each in namespaces] == [each for each in args if each.startswith("--namespace")]
    assert [f"--allowed-kinds={each}" for each in kinds] == [each for each in args if each.startswith("--allowed-k")]


def test_a_kind_unknown_to_the_manager_needs_its_plural(helm: Helm) -> None:
    kind = {"kind": "argoproj.io/v1alpha1/Rollout", "plural": "rollouts"}
    given = {"manager": {"allowedKinds": ["v1/Pod", kind]}, "userRoles": {"create": False}}
    rendered = helm.rendered(given)
    rights = [each for key, found in granted(rendered.manifests).items() if key[0] == "ClusterRole" for each in found]
    assert {verb for group, resource, verb, _ in rights if (group, resource) == ("argoproj.io", "rollouts")} == {
        "get", "list", "watch", "create", "patch", "delete"
    }  # fmt: skip
    with pytest.raises(HelmError, match=r"manager.allowedKinds: .*argoproj.io/v1alpha1/Rollout.*plural"):
        helm.rendered({"manager": {"allowedKinds": [kind["kind"]]}})


@pytest.mark.parametrize("namespaces", [[], ["south", "north"]])
def test_the_charts_webhook_is_the_one_that_the_manager_prints(helm: Helm, namespaces: list[str]) -> None:
    rendered = helm.rendered({"manager": {"namespaces": namespaces}})
    wanted = printed(
        "webhooks", "--service", "town/wayside-webhook", "--name", "wayside-town",
        *(word for each in namespaces for word in ("--namespace", each)), "--detectors",
    )  # fmt: skip
    assert [each["kind"] for each in wanted] == ["ValidatingWebhookConfiguration", "MutatingWebhookConfiguration"]
    for each in wanted:
        found = rendered.one(each["kind"])
        assert found["webhooks"] == each["webhooks"]
        assert found["metadata"]["name"] == each["metadata"]["name"]
    without = helm.rendered({"webhook": {"sidecars": False}})
    assert not without.of("MutatingWebhookConfiguration")
    assert without.of("ValidatingWebhookConfiguration")


def test_cert_manager_or_another_issuer_can_provide_the_webhooks_certificate(helm: Helm) -> None:
    issuer = {"name": "authority", "kind": "ClusterIssuer"}
    rendered = helm.rendered({"webhook": {"certificates": {"from": "CertManager", "issuerRef": issuer}}})
    certificate, hook = rendered.one("Certificate"), rendered.one("ValidatingWebhookConfiguration")
    assert certificate["spec"]["issuerRef"] == issuer
    for each in (hook, rendered.one("MutatingWebhookConfiguration")):
        assert each["metadata"]["annotations"] == {"cert-manager.io/inject-ca-from": "town/wayside-webhook"}
        assert "caBundle" not in each["webhooks"][0]["clientConfig"]
    assert not rendered.of("Secret")
    assert mounted(rendered) == certificate["spec"]["secretName"]
    given = {"from": "Secret", "secretName": "mine", "caBundle": "YWJj"}
    rendered = helm.rendered({"webhook": {"certificates": given}})
    assert mounted(rendered) == "mine"
    for kind in ("ValidatingWebhookConfiguration", "MutatingWebhookConfiguration"):
        assert rendered.one(kind)["webhooks"][0]["clientConfig"]["caBundle"] == "YWJj"
    with pytest.raises(HelmError, match=r"webhook\.certificates\.secretName is empty"):
        helm.rendered({"webhook": {"certificates": {"from": "Secret"}}})


def mounted(rendered: Rendered) -> str:
    """The Secret of the manager's certificates."""
    volumes = rendered.one("Deployment", "wayside-manager")["spec"]["template"]["spec"]["volumes"]
    (found,) = (each["secret"]["secretName"] for each in volumes if each["name"] == "certificates")
    return str(found)
