"""The promises in the table of attacks in docs/security.md about authors of templates, tasks, rules and detectors.

The namespace enforces the restricted Pod Security Standard, and the manager runs under the rights that it prints.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import yaml

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api, ApiError, Object
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import (
    condition,
    config,
    deployment,
    has_status,
    start_manager,
    task,
    template,
    wait_settled,
)
from tests.cluster.manifests import DETECTOR
from tests.cluster.namespaces import new_namespace
from tests.cluster.processes import Process, Processes
from tests.cluster.test_manager_rbac import printed, put, wait_in_force
from tests.cluster.waiting import wait_until
from tests.guides import ROOT

RESTRICTED = {"pod-security.kubernetes.io/enforce": "restricted"}
MEMORY = 1 << 30  # the limit of the chart
ANYTHING = {"v": {"type": "string"}, "region": {"type": "string", "required": True}}


@pytest.fixture
def attacked(api: Api, namespace: str, control_plane: ControlPlane, processes: Processes) -> Process:
    """A manager of the namespace with only its own rights, and an application of a well-behaved user."""
    api.patch("Namespace", namespace, {"metadata": {"labels": RESTRICTED}})
    api.create({"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": "manager"}})
    account = control_plane.kubeconfig_of_service_account(namespace, "manager")
    put(api, manifests := printed("--namespace", namespace, "--account", f"{namespace}/manager"))
    wait_in_force(account, namespace, manifests)
    manager = start_manager(processes, namespace, kubeconfig=account)
    api.create(template("good", manifests=[pod()]))
    api.create(task("north", of="good"))
    api.wait_for("Deployment", instance_name("good", "north"), lambda _: True, what="the good application runs")
    return manager


def served(api: Api, name: str) -> None:
    """Wait until a new task of the good template is served."""
    api.create(task(name, of="good"))
    api.wait_for("Deployment", instance_name("good", name), lambda _: True, what="others are served")


def pod(security: Object | None = None, **spec: Any) -> Object:
    """A Deployment whose pod meets the restricted standard except for these fields; `security`: of its container."""
    made = deployment()
    made["spec"]["template"]["spec"] |= spec
    meets = {"allowPrivilegeEscalation": False, "runAsNonRoot": True, "capabilities": {"drop": ["ALL"]}}
    meets["seccompProfile"] = {"type": "RuntimeDefault"}
    (container,) = made["spec"]["template"]["spec"]["containers"]
    container["securityContext"] = meets | (security or {})
    return made


def of_kind(api_version: str, kind: str, **more: Any) -> Object:
    return {"apiVersion": api_version, "kind": kind, "metadata": {"name": "${instance.name}"}, **more}


def named(name: str, **metadata: Any) -> Object:
    return config({"a": "b"}) | {"metadata": {"name": name, **metadata}}


RBAC = "rbac.authorization.k8s.io/v1"
NOT_ALLOWED = "is not a kind that the administrator allows"
NO_NAME = "must have at most 253 lower-case letters"
JOB = {"template": {"spec": {"serviceAccountName": "admin", "containers": [{"name": "a", "image": "a"}]}}}
BY_TEMPLATE: dict[str, tuple[Object, str]] = {
    "namespace": (named("${instance.name}", namespace="kube-system"), "is not the template's own namespace"),
    "namespace-by-parameter": (
        named("${instance.name}", namespace="${parameters.v}"),
        "is not the template's own namespace",
    ),
    "path": (named("${instance.name}/../../../../kube-system/configmaps/${parameters.v}"), NO_NAME),
    "path-by-parameter": (named("${instance.name}${parameters.v}"), NO_NAME),
    "role": (of_kind(RBAC, "Role", rules=[]), NOT_ALLOWED),
    "binding": (of_kind(RBAC, "ClusterRoleBinding"), NOT_ALLOWED),
    "account": (of_kind("v1", "ServiceAccount"), NOT_ALLOWED),
    "secret": (of_kind("v1", "Secret"), NOT_ALLOWED),
    "volume": (of_kind("v1", "PersistentVolume"), NOT_ALLOWED),
    "webhook": (of_kind("admissionregistration.k8s.io/v1", "MutatingWebhookConfiguration"), NOT_ALLOWED),
    "task": (of_kind("wayside.dev/v1alpha1", "ApplicationTask"), NOT_ALLOWED),
    "list": (of_kind("v1", "List", items=[of_kind("v1", "Secret")]), NOT_ALLOWED),
    "kind-by-parameter": (of_kind("v1", "${parameters.v}"), "must be literal"),
    "pods-account": (pod(serviceAccountName="admin"), "'admin' is not a service account"),
    "pods-account-by-parameter": (pod(serviceAccountName="${parameters.v}"), "is not a service account"),
    "jobs-account": (of_kind("batch/v1", "Job", spec=JOB), "'admin' is not a service account"),
    "cron-jobs-account": (
        of_kind("batch/v1", "CronJob", spec={"schedule": "* * * * *", "jobTemplate": {"spec": JOB}}),
        "'admin' is not a service account",
    ),
    "token": (pod(automountServiceAccountToken=True), "would mount the token of the service account default"),
    "owner": (
        named("${instance.name}", ownerReferences=[{"kind": "Node", "name": "n", "uid": "u", "apiVersion": "v1"}]),
        "metadata.ownerReferences",
    ),
    "finalizer": (named("${instance.name}", finalizers=["a.example/b"]), "metadata.finalizers"),
}
"""Manifests that the manager rejects, each with a part of the reason."""

HOST: dict[str, tuple[Object, Object, str]] = {
    "network": ({"hostNetwork": True}, {}, "hostNetwork=true"),
    "processes": ({"hostPID": True}, {}, "hostPID=true"),
    "files": ({"volumes": [{"name": "root", "hostPath": {"path": "/"}}]}, {}, 'uses restricted volume type "hostPath"'),
    "privileges": ({}, {"privileged": True, "allowPrivilegeEscalation": True}, "privileged"),
    "root": ({}, {"runAsUser": 0}, "must not set runAsUser=0"),
    "capabilities": ({}, {"capabilities": {"drop": ["ALL"], "add": ["SYS_ADMIN"]}}, 'must not include "SYS_ADMIN"'),
}
"""Access to the node that a pod may not have: fields of the pod and of its container's security context, and part of
the reason. Otherwise the pod meets the namespace's standard."""

HOSTILE = ("../../x", "x: y\n", '"}', "${parameters.region}", "$${v}", "'; drop", "{{ .Values }}", "\u202e", "system")
"""Parameter values that have a meaning in other languages."""


def refusal(api: Api, name: str) -> str:
    """The errors so far in the template's or its instance's status."""
    raws = [api.get("ApplicationTemplate", name), api.find("ApplicationInstance", instance_name(name, "north"))]
    wrong = [condition(raw, type_) for raw in raws if raw is not None for type_ in ("Accepted", "Applied")]
    return " ".join(each["message"] for each in wrong if each.get("status") == "False")


def test_no_forbidden_object_is_created(api: Api, attacked: Process) -> None:
    mine = {each["metadata"]["uid"] for each in api.list("ConfigMap", namespace="kube-system")}
    for name, (manifest, _) in BY_TEMPLATE.items():
        api.create(template(name, parameters=ANYTHING, manifests=[manifest]))
        api.create(task(name, of=name, region="north", v="/../kube-system"))
    for name, (spec, security, _) in HOST.items():
        api.create(template(f"host-{name}", manifests=[pod(security, **spec)]))
        api.create(task(f"host-{name}", of=f"host-{name}", region="north"))
    wait_until(
        lambda: {name: refusal(api, name) for name, (_, part) in BY_TEMPLATE.items() if part not in refusal(api, name)},
        lambda wrong: not wrong,
        what="each is rejected with its reason",
    )
    for name, (_, _, part) in HOST.items():
        api.wait_for(
            "ApplicationInstance",
            instance_name(f"host-{name}", "north"),
            lambda raw, part=part: part in condition(raw, "Ready").get("message", ""),  # type: ignore[misc]
            what=f"the status contains {part}",
        )
    served(api, "later")
    api.wait_list("Pod", lambda found: len(found) == 2, what="the application that meets the standard has its pods")
    assert {each["metadata"]["uid"] for each in api.list("ConfigMap", namespace="kube-system")} == mine
    assert {each["metadata"]["labels"]["app"] for each in api.list("Pod")} == {
        instance_name("good", name) for name in ("north", "later")
    }
    made = [(each["kind"], each["metadata"]["name"]) for kind in MADE for each in api.list(kind, labels=OURS)]
    attempts = [f"host-{name}" for name in HOST if name != "privileges"]  # the API server rejects it in a Deployment
    assert sorted(made) == sorted(
        ("Deployment", instance_name(name, key))
        for name, key in [("good", "north"), ("good", "later"), *((each, "north") for each in attempts)]
    )


OURS = "app.kubernetes.io/managed-by=wayside"
MADE = ("ConfigMap", "Secret", "ServiceAccount", "Deployment", "Job", "CronJob", "Role", "ApplicationTask")


def test_parameter_values_are_never_evaluated_and_other_templates_are_out_of_reach(
    api: Api, attacked: Process, control_plane: ControlPlane
) -> None:
    other = control_plane.api(new_namespace(control_plane.api(), "other"))
    other.create(template("theirs"))
    data = {"plain": "${parameters.v}", "within": "a ${parameters.v} b"}
    api.create(template("echo", parameters=ANYTHING, manifests=[config(data)]))
    for index, value in enumerate(HOSTILE):
        api.create(task(f"value-{index}", of="echo", region=f"value-{index}", v=value))
    for index, value in enumerate(HOSTILE):
        made = api.wait_for(
            "ConfigMap", f"{instance_name('echo', f'value-{index}')}-config", lambda _: True, what=f"{value!r} is taken"
        )
        assert made["data"] == {"plain": value, "within": f"a {value} b"}
    for name in (f"{other.namespace}/theirs", "../theirs", f"theirs.{other.namespace}"):
        with pytest.raises(ApiError, match=r"spec\.template"):
            api.create(task("foreign", of=name))
    api.create(task("foreign", of="theirs"))
    api.wait_for(
        "ApplicationTask",
        "foreign",
        lambda raw: condition(raw, "Accepted").get("reason") == "TemplateNotFound",
        what="the template of the other namespace is not found",
    )
    assert other.list("ApplicationInstance") == []
    wait_settled(api)


LARGE: Object = {str(index): "x" * 15_000 for index in range(60)}
"""900 kB in a map of at most 64 members."""
STARTED = {"ros2": {"service": "/s", "type": "std_srvs/srv/Trigger", "request": LARGE}}
STARTED |= {"http": {"url": "http://127.0.0.1:9/", "body": LARGE}}


def action(**spec: Any) -> Object:
    return {"actions": [{"name": "a", **spec}]}


FREE: dict[tuple[str, str], Object] = {
    ("ApplicationInstance", "parameters{}"): {"templateName": "good", "parameters": {"region": "x", "v": LARGE}},
    ("ApplicationTask", "parameters{}"): {"templateName": "good", "parameters": {"region": "x", "v": LARGE}},
    ("ApplicationTask", "event.values{}"): {
        "templateName": "good",
        "parameters": {"region": "v"},
        "event": {
            "id": "0",
            "rule": "r",
            "action": "a",
            "subject": "s",
            "onsetTime": "2026-01-02T03:04:05Z",
            "startTime": "2026-01-02T03:04:05Z",
            "values": {"v": LARGE},
        },
    },
    ("ApplicationTemplate", "parameters{}.default"): {
        "parameters": ANYTHING | {"d": {"type": "object", "default": LARGE}},
        "manifests": [config({"a": "b"})],
    },
    ("ApplicationTemplate", "parameters{}.enum[]"): {
        "parameters": {"d": {"type": "string", "enum": [name + text for name, text in LARGE.items()]}},
        "manifests": [config({"a": "b"})],
    },
    ("ApplicationTemplate", "baseline.parameters{}"): {
        "parameters": {"d": {"type": "object"}},
        "baseline": {"parameters": {"d": LARGE}},
        "manifests": [config({"a": "${parameters.d}"})],
    },
    ("ApplicationTemplate", "configuration{}"): {
        "configuration": {"a.json": LARGE},
        "baseline": {},
        "manifests": [config({"a": "b"})],
    },
    ("ApplicationTemplate", "manifests[]"): {"manifests": [config(LARGE)], "baseline": {}},
    ("ApplicationTemplate", "helm.values"): {
        "helm": {"chart": "/charts/none", "values": LARGE},
        "baseline": {},
    },
    ("Detector", "sources[].parameters{}"): DETECTOR["spec"]
    | {
        "sources": [{"name": "s", "plugin": "mqtt", "parameters": LARGE}],
    },
    ("Detector", "clients[].parameters{}{}"): DETECTOR["spec"]
    | {"clients": [{"name": "c", "parameters": {"v": LARGE}}]},
    ("Detector", "pod.affinity"): DETECTOR["spec"] | {"mode": "Standalone", "pod": {"affinity": LARGE}},
    ("Detector", "pod.securityContext"): DETECTOR["spec"] | {"mode": "Standalone", "pod": {"securityContext": LARGE}},
    **{
        ("Detector", f"pod.volumes[].{source}"): DETECTOR["spec"]
        | {"mode": "Standalone", "pod": {"volumes": [{"name": "v", source: LARGE}]}}
        for source in ("persistentVolumeClaim", "ephemeral", "emptyDir", "configMap", "secret", "projected", "csi")
    },
    ("EventRule", "each.of[]"): {"each": {"as": "site", "of": [{"name": "n", **LARGE}]}},
    ("EventRule", "parameters{}"): {"parameters": {"v": LARGE}},
    ("EventRule", "signals[].plugin.parameters{}"): {
        "signals": [{"name": "s", "plugin": {"name": "p", "parameters": LARGE}}]
    },
    ("EventRule", "actions[].deploy.parameters{}"): action(deploy={"templateName": "good", "parameters": {"v": LARGE}}),
    ("EventRule", "actions[].record.metadata{}"): action(record={"metadata": {"v": LARGE}}),
    ("EventRule", "actions[].trigger.ros2.start.request{}"): action(trigger={"ros2": {"start": STARTED["ros2"]}}),
    ("EventRule", "actions[].trigger.ros2.stop.request{}"): action(
        trigger={"ros2": {"start": STARTED["ros2"] | {"request": {}}, "stop": STARTED["ros2"]}}
    ),
    ("EventRule", "actions[].trigger.http.start.body{}"): action(trigger={"http": {"start": STARTED["http"]}}),
    ("EventRule", "actions[].trigger.http.stop.body{}"): action(
        trigger={"http": {"start": {"url": "http://127.0.0.1:9/"}, "stop": STARTED["http"]}}
    ),
    ("EventRule", "actions[].database.metadata{}"): action(database={"metadata": {"v": LARGE}}),
    ("EventRule", "actions[].plugin.parameters{}"): action(plugin={"name": "p", "parameters": LARGE}),
    ("EventRule", "actions[].plugin.values{}"): action(plugin={"name": "p", "values": {"v": LARGE}}),
}
"""900 kB in each field of free-form data: the spec by kind and field; for an EventRule its other fields."""


def free_fields() -> Iterator[tuple[str, str]]:
    """The fields of free-form data in the specs of all kinds."""

    def walk(schema: Object, path: str) -> Iterator[str]:
        if schema.get("x-kubernetes-preserve-unknown-fields"):
            yield path.removeprefix(".")
            return  # all deeper fields are free-form as well
        for name, child in schema.get("properties", {}).items():
            yield from walk(child, f"{path}.{name}")
        for key, sign in (("items", "[]"), ("additionalProperties", "{}")):
            if isinstance(child := schema.get(key), dict):
                yield from walk(child, f"{path}{sign}")

    for file in (ROOT / "crds").glob("*.yaml"):
        crd = yaml.safe_load(file.read_text())
        schema = crd["spec"]["versions"][0]["schema"]["openAPIV3Schema"]["properties"]["spec"]
        yield from ((crd["spec"]["names"]["kind"], path) for path in walk(schema, ""))


def test_900_kb_in_every_field_that_takes_free_data_harms_no_other(api: Api, attacked: Process) -> None:
    assert sorted(FREE) == sorted(free_fields())
    stored = []
    for index, ((kind, path), spec) in enumerate(FREE.items()):
        whole = {"scope": {"client": {}}, "when": "true", **spec} if kind == "EventRule" else spec
        manifest = {"apiVersion": "wayside.dev/v1alpha1", "kind": kind, "metadata": {"name": f"large-{index}"}}
        problem = refused(api, manifest | {"spec": whole})
        assert "unknown field" not in problem, path
        if not problem:
            stored.append((kind, f"large-{index}"))
    assert len(stored) > 20
    for kind, name in stored:
        api.wait_for(kind, name, has_status, what=f"{kind} {name} has a status")
    served(api, "later")
    assert attacked.alive
    assert 0 < attacked.resident_bytes() < MEMORY


def refused(api: Api, manifest: Object) -> str:
    """The reason why the API server rejects the object; empty if it stores it."""
    try:
        api.create(manifest)
    except ApiError as error:
        return error.message
    return ""


def test_expensive_expressions_in_a_rule_delay_nothing_else(api: Api, attacked: Process) -> None:
    items = str(list(range(10)))
    loops = "1"
    for variable in "abcdefgh":  # a hundred million steps
        loops = f"{items}.filter({variable}, {loops} > 0).size()"
    nested = "[1]"
    for _ in range(12):
        nested = f"{nested}.map(x, {nested})"
    for index, bomb in enumerate((loops, nested)):
        rule = {"scope": {"client": {}}, "when": f"size([{bomb}]) > 0"}
        rule |= action(deploy={"templateName": "good", "parameters": {"region": f"${{{bomb}}}"}})
        manifest = {"apiVersion": "wayside.dev/v1alpha1", "kind": "EventRule", "metadata": {"name": f"bomb-{index}"}}
        if not refused(api, manifest | {"spec": rule}):
            api.wait_for("EventRule", f"bomb-{index}", has_status, what="it is judged")
    served(api, "later")
    assert attacked.alive
    assert 0 < attacked.resident_bytes() < MEMORY
