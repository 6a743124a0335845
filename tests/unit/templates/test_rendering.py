"""Rendering: a template and an instance give manifests, or the template's errors."""

from __future__ import annotations

import copy
import json
from typing import Any

import pytest

from application_manager.core.objects.ownership import owned
from application_manager.core.objects.policy import DEFAULT_KINDS, SECRET, Policy
from application_manager.core.objects.rendering import Renderer, RenderError
from tests.unit.manager_objects import DEPLOYMENT, instance, template

CONFIG: dict[str, Any] = {
    "apiVersion": "v1",
    "kind": "ConfigMap",
    "metadata": {"name": "${instance.name}-config"},
    "data": {"rate": "${parameters.rate} Hz", "run.sh": 'cd "$${HOME}" && exec app'},
}


def changed(manifest: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """The manifest with another value at a dotted path; None removes it."""
    result = copy.deepcopy(manifest)
    *parents, last = path.split(".")
    here: Any = result
    for part in parents:
        here = here[int(part)] if isinstance(here, list) else here.setdefault(part, {})
    if value is None:
        del here[last]
    else:
        here[last] = value
    return result


def render(*manifests: dict[str, Any], policy: Policy | None = None, key: str | None = None, **values: Any) -> Any:
    spec: dict[str, Any] = {"manifests": list(manifests), "parameters": values.pop("declared", {})}
    if key is not None:
        spec["key"] = "${parameters.region}"
        spec["parameters"] = {"region": {"type": "string"}}
    return Renderer(template(**spec), policy or Policy()).render(instance(key=key, parameters=values))


def refusal(*manifests: dict[str, Any], **values: Any) -> str:
    with pytest.raises(RenderError) as caught:
        render(*manifests, **values)
    return str(caught.value)


def test_values_are_filled_in_and_labels_show_whose_the_object_is() -> None:
    declared = {"rate": {"type": "number"}}
    deployment, config = render(DEPLOYMENT, CONFIG, declared=declared, rate=10.0).manifests
    assert deployment["metadata"]["name"] == "app"
    assert config["data"] == {"rate": "10 Hz", "run.sh": 'cd "${HOME}" && exec app'}
    assert config["metadata"] == {
        "name": "app-config",
        "namespace": "site",
        "labels": {
            "app.kubernetes.io/managed-by": "wayside",
            "wayside.dev/instance": "app",
            "wayside.dev/template": "app",
        },
    }


def test_integral_doubles_become_integers() -> None:
    manifest = changed(DEPLOYMENT, "spec.replicas", "${parameters.n * 2}")
    rendered = render(manifest, declared={"n": {"type": "integer"}}, n=2.0).manifests[0]
    assert json.dumps(rendered["spec"]["replicas"]) == "4"


def test_an_unset_parameter_drops_its_field() -> None:
    manifest = changed(DEPLOYMENT, "spec.replicas", "${parameters.n}")
    assert "replicas" not in render(manifest, declared={"n": {"type": "integer"}}).manifests[0]["spec"]


def test_the_same_inputs_give_the_same_digest_and_others_another() -> None:
    declared = {"rate": {"type": "number"}}
    first, again = (render(CONFIG, declared=declared, rate=rate) for rate in (10, 10.0))
    assert first.digest == again.digest
    assert render(CONFIG, declared=declared, rate=11).digest != first.digest


def test_the_instance_owns_and_controls_its_objects() -> None:
    mine = instance()
    (reference,) = owned(render(DEPLOYMENT).manifests[0], mine)["metadata"]["ownerReferences"]
    assert reference == {
        "apiVersion": "wayside.dev/v1alpha1",
        "kind": "ApplicationInstance",
        "name": "app",
        "uid": "uid-app",
        "controller": True,
    }


def test_the_token_of_the_default_account_is_not_mounted() -> None:
    pod = render(DEPLOYMENT).manifests[0]["spec"]["template"]["spec"]
    assert pod["automountServiceAccountToken"] is False


def test_a_listed_account_keeps_its_token() -> None:
    manifest = changed(DEPLOYMENT, "spec.template.spec.serviceAccountName", "reader")
    pod = render(manifest, policy=Policy(service_accounts=frozenset({"reader"}))).manifests[0]
    assert "automountServiceAccountToken" not in pod["spec"]["template"]["spec"]


@pytest.mark.parametrize(
    ("path", "value", "parts"),
    [
        (
            "spec.template.metadata.labels.x",
            "${parameter.region}",
            ["spec.manifests[0].spec.template.metadata.labels.x", "parameter", "did you mean"],
        ),
        ("spec.replicas", "${parameters.n}", ["spec.manifests[0].spec.replicas", "`parameters.n` does not exist"]),
        ("metadata.name", "${instance.nam}", ["`instance.nam` does not exist", "name, key, namespace"]),
        ("spec.template.spec.containers.0.args", ["cd ${HOME}"], ["containers[0].args[0]", "HOME", "`$${`"]),
        ("spec.template.spec.containers.0.args", ["echo ${x"], ["containers[0].args[0]", "not closed", "`$${`"]),
        ("metadata.namespace", "elsewhere", ["metadata.namespace: 'elsewhere' is not the template's own", "remove"]),
        ("kind", "ServiceAccount", ["spec.manifests[0].kind", "apps/v1/ServiceAccount", "the allowed kinds are"]),
        ("apiVersion", "apps/v1beta1", ["apps/v1beta1/Deployment", "write apps/v1/Deployment"]),
        ("metadata.name", 7, ["metadata.name: must be a string"]),
        ("metadata.name", None, ["metadata.name", "must be a string"]),
        ("metadata.ownerReferences", [], ["metadata.ownerReferences", "remove it"]),
        ("metadata.finalizers", ["x/y"], ["metadata.finalizers", "remove it"]),
        (
            "spec.template.spec.serviceAccountName",
            "admin",
            ["spec.template.spec.serviceAccountName", "'admin'", "use one of default"],
        ),
        (
            "spec.template.spec.automountServiceAccountToken",
            True,
            ["spec.template.spec.automountServiceAccountToken", "would mount the token"],
        ),
        (
            "spec.template.spec.volumes",
            [{"name": "t", "projected": {"sources": [{"serviceAccountToken": {"path": "t"}}]}}],
            ["volumes[0].projected.sources[0].serviceAccountToken"],
        ),
    ],
)
def test_forbidden_template_content_is_reported_by_field(path: str, value: Any, parts: list[str]) -> None:
    message = refusal(changed(DEPLOYMENT, path, value))
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    ("api_version", "kind", "name", "allowed"),
    [
        ("v1", "Service", "a" * 64, "at most 63 lower-case letters, digits and -,"),
        ("v1", "Service", "${instance.name}.site", "at most 63 lower-case letters, digits and -,"),
        ("batch/v1", "Job", "a" * 64, "at most 63 lower-case letters, digits, - and .,"),
        ("batch/v1", "CronJob", "a" * 53, "at most 52 lower-case letters, digits, - and .,"),
        ("v1", "ConfigMap", "a..b", "at most 253 lower-case letters, digits, - and .,"),
    ],
)
def test_a_name_that_the_kind_may_not_have_is_reported_before_anything_is_applied(
    api_version: str, kind: str, name: str, allowed: str
) -> None:
    message = refusal({"apiVersion": api_version, "kind": kind, "metadata": {"name": name}})
    assert f"spec.manifests[0].metadata.name: must have {allowed}" in message


ANYWHERE = [
    ("apps/v1", "ReplicaSet", "spec.template.spec"),
    ("argoproj.io/v1alpha1", "Rollout", "spec.template.spec"),
    ("serving.knative.dev/v1", "Service", "spec.template.spec"),
    ("example.dev/v1", "Fleet", "spec.members[0].pod"),
]


def making_pods(api_version: str, kind: str, where: str, pod: dict[str, Any]) -> dict[str, Any]:
    inside = {"members": [{"pod": pod}]} if "members" in where else {"template": {"spec": pod}}
    return {"apiVersion": api_version, "kind": kind, "metadata": {"name": "app"}, "spec": inside}


@pytest.mark.parametrize(("api_version", "kind", "where"), ANYWHERE)
def test_pod_specs_are_checked_in_any_kind(api_version: str, kind: str, where: str) -> None:
    policy = Policy(kinds=frozenset({(api_version, kind)}))
    containers = [{"name": "main", "image": "app:1"}]
    manifest = making_pods(api_version, kind, where, {"containers": containers, "serviceAccountName": "admin"})
    assert list(policy.pod_problems(manifest)) == [
        (f"{where}.serviceAccountName", "'admin' is not a service account that the administrator allows: "
         "use one of default")
    ]  # fmt: skip
    mounting = making_pods(api_version, kind, where, {"containers": containers, "automountServiceAccountToken": True})
    assert [field for field, _ in policy.pod_problems(mounting)] == [f"{where}.automountServiceAccountToken"]
    plain = policy.completed(making_pods(api_version, kind, where, {"containers": containers}))
    assert list(policy.pod_problems(plain)) == []
    assert "'automountServiceAccountToken': False" in str(plain)


def test_an_account_named_outside_of_a_pod_must_be_listed_too() -> None:
    policy, workflow = Policy(), {"apiVersion": "argoproj.io/v1alpha1", "kind": "Workflow", "metadata": {"name": "w"}}
    assert [field for field, _ in policy.pod_problems(workflow | {"spec": {"serviceAccountName": "admin"}})] == [
        "spec.serviceAccountName"
    ]
    assert list(policy.pod_problems(CONFIG | {"data": {"serviceAccountName": "admin", "containers": "none"}})) == []


def test_compile_errors_and_unknown_names_are_reported_together() -> None:
    manifest = changed(DEPLOYMENT, "spec.replicas", "${parameters.n}")
    manifest = changed(manifest, "spec.template.spec.containers.0.args", ["${1 +}", "${instance.nam}"])
    message = refusal(manifest)
    for part in ("`parameters.n` does not exist", "args[0], line 1", "`instance.nam` does not exist"):
        assert part in message


def test_all_problems_are_reported_at_once() -> None:
    message = refusal(
        changed(DEPLOYMENT, "spec.replicas", "${parameters.n}"),
        changed(CONFIG, "data", {"a": "${b}"}),
    )
    assert "manifests[0].spec.replicas" in message
    assert "manifests[1].data.a" in message


def test_a_secret_needs_permission_and_never_contains_a_service_accounts_token() -> None:
    secret = {"apiVersion": "v1", "kind": "Secret", "metadata": {"name": "s"}}
    assert "v1/Secret is not a kind that the administrator allows" in refusal(secret)
    allowed = Policy(DEFAULT_KINDS | {SECRET})
    assert len(render(secret, policy=allowed).manifests) == 1
    token = {**secret, "type": "kubernetes.io/service-account-token"}
    assert "service-account-token" in refusal(token, policy=allowed)


def test_with_a_key_each_name_must_identify_the_instance() -> None:
    assert render(DEPLOYMENT, key="north").manifests[0]["metadata"]["name"] == "app"
    message = refusal({**CONFIG, "metadata": {"name": "config"}, "data": {}}, key="north")
    assert "must contain ${instance.name}" in message


def test_two_objects_of_the_same_kind_and_name_are_rejected() -> None:
    assert "Deployment 'app' is given twice" in refusal(DEPLOYMENT, DEPLOYMENT)


def test_an_expression_that_fails_on_the_values_is_reported_with_its_place() -> None:
    manifest = changed(DEPLOYMENT, "spec.replicas", "${parameters.list[3]}")
    message = refusal(manifest, declared={"list": {"type": "array"}}, list=[1])
    assert "spec.manifests[0].spec.replicas" in message


def test_values_are_never_evaluated_again() -> None:
    config = {**CONFIG, "data": {"text": "${parameters.text}"}}
    rendered = render(config, declared={"text": {"type": "string"}}, text="${instance.name}").manifests[0]
    assert rendered["data"] == {"text": "${instance.name}"}


def test_a_manually_created_instance_gets_the_defaults_and_its_values_are_checked() -> None:
    declared = {"rate": {"type": "number", "default": 5}}
    assert render(CONFIG, declared=declared).manifests[0]["data"]["rate"] == "5 Hz"
    assert "spec.parameters.rate" in refusal(CONFIG, declared=declared, rate="fast")


@pytest.mark.parametrize("kind", ["rbac.authorization.k8s.io/v1/Role", "v1/ServiceAccount", "wayside.dev/v1alpha1/X"])
def test_some_kinds_cannot_be_allowed(kind: str) -> None:
    with pytest.raises(ValueError, match="can never be allowed"):
        Policy.parse([kind], None)


def test_a_kind_without_a_version_is_rejected() -> None:
    with pytest.raises(ValueError, match="must be apiVersion/Kind"):
        Policy.parse(["Deployment"], None)
