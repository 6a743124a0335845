"""Errors are reported in place, with field, value and remedy, and everything else continues."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api, ApiError, Object
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import condition, config, deployment, start_manager, task, template, wait_settled
from tests.cluster.processes import Process, Processes, environment_of

pytestmark = pytest.mark.own_control_plane  # this manager serves all namespaces

BAD = instance_name("bad", "north")


@pytest.fixture(scope="module")
def manager(own_control_plane: ControlPlane, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Process]:
    """One manager for all these tests and their namespaces, so they also show that it survives each of them."""
    processes = Processes(tmp_path_factory.mktemp("logs"), environment_of(own_control_plane.kubeconfig))
    yield start_manager(processes)
    processes.kill_all()


@pytest.fixture
def unharmed(api: Api, manager: Process) -> Iterator[None]:
    """Another application runs during the block and is unchanged afterwards; a later task is served as well."""
    api.create(template("good"))
    api.create(task("before", of="good"))
    name = instance_name("good", "before")
    first = api.wait_for("Deployment", name, lambda _: True, what="the good application runs")["metadata"]
    yield
    api.create(task("after", of="good"))
    api.wait_for("Deployment", instance_name("good", "after"), lambda _: True, what="a later application runs")
    wait_settled(api, refused=[BAD])
    last = api.get("Deployment", name)["metadata"]
    assert (last["uid"], last["generation"]) == (first["uid"], first["generation"])
    assert manager.alive


def wait_for_false(api: Api, kind: str, name: str, type_: str, parts: list[str]) -> Object:
    """Wait until the object's condition is False and its message has all these parts; return the condition.

    The first message may be a different one, e.g. for a task that arrives before its template.
    """

    def shows(raw: Object) -> bool:
        reported = condition(raw, type_)
        return reported.get("status") == "False" and all(part in reported["message"] for part in parts)

    return condition(
        api.wait_for(kind, name, shows, what=f"{type_} of {kind} {name} is False and contains {parts}"), type_
    )


def changed(container: Object) -> Object:
    made = deployment()
    made["spec"]["template"]["spec"]["containers"][0] |= container
    return made


@pytest.mark.parametrize(
    ("spec", "reason", "parts"),
    [
        ({"templateName": "nowhere"}, "TemplateNotFound", ["spec.templateName", "'nowhere'", "create it"]),
        (
            {"templateName": "good", "parameters": {"region": 7}},
            "InvalidParameters",
            ["spec.parameters.region: 7", "not of type string", "give a value of type string"],
        ),
        (
            {"templateName": "good", "parameters": {"region": "x" * 35_000, "more": "x" * 35_000}},
            "InvalidParameters",
            ["spec.parameters: takes", "65536"],
        ),
    ],
    ids=["unknown template", "wrong type", "too large"],
)
@pytest.mark.usefixtures("unharmed")
def test_a_task_that_cannot_be_served_reports_the_reason(api: Api, spec: Object, reason: str, parts: list[str]) -> None:
    api.create({**task("wrong"), "spec": spec})
    accepted = wait_for_false(api, "ApplicationTask", "wrong", "Accepted", parts)
    assert accepted["reason"] == reason
    assert api.get("ApplicationTask", "wrong")["status"]["phase"] == "Refused"


@pytest.mark.parametrize(
    ("manifest", "parts"),
    [
        (
            changed({"image": "app:${parameters.version}"}),
            ["spec.manifests[0].spec.template.spec.containers[0].image", "`parameters.version` does not", "region"],
        ),
        (
            {**config({}), "apiVersion": "rbac.authorization.k8s.io/v1", "kind": "Role"},
            [
                "spec.manifests[0].kind",
                "rbac.authorization.k8s.io/v1/Role is not a kind that the administrator allows",
            ],
        ),
    ],
    ids=["unknown parameter", "forbidden kind"],
)
@pytest.mark.usefixtures("unharmed")
def test_a_template_that_cannot_be_rendered_reports_the_reason(api: Api, manifest: Object, parts: list[str]) -> None:
    api.create(template("bad", manifests=[manifest]))
    api.create(task("north", of="bad"))
    wait_for_false(api, "ApplicationTemplate", "bad", "Accepted", parts)
    wait_for_false(api, "ApplicationInstance", BAD, "Applied", parts)
    wait_for_false(api, "ApplicationTask", "north", "Applied", parts)


@pytest.mark.parametrize(
    ("manifest", "parts"),
    [
        (
            {**config({}), "metadata": {"name": "${instance.name}", "namespace": "kube-system"}},
            ["spec.manifests[0].metadata.namespace: 'kube-system'", "remove the field"],
        ),
        (config({}, name="fixed"), ["spec.manifests[0].metadata.name: 'fixed'", "must contain ${instance.name}"]),
        (changed({"image": 7}), ["image: expected string, got 7", "correct the template"]),
        (changed({"imagee": "x"}), ["imagee", "field not declared in schema"]),
        (config({"x" * 300: "y"}), ["ConfigMap", "must be no more than 253"]),
    ],
    ids=["another namespace", "a name for all", "wrong type", "unknown field", "refused by the API server"],
)
@pytest.mark.usefixtures("unharmed")
def test_an_instance_that_cannot_be_applied_reports_the_reason(api: Api, manifest: Object, parts: list[str]) -> None:
    api.create(template("bad", manifests=[manifest]))
    api.create(task("north", of="bad"))
    wait_for_false(api, "ApplicationInstance", BAD, "Applied", parts)
    assert not api.find("ConfigMap", BAD, namespace="kube-system")


def test_an_escaped_brace_reaches_the_shell_unchanged(api: Api, manager: Process) -> None:
    api.create(
        template("bad", manifests=[changed({"command": ["sh", "-c", 'cd "$${HOME}" && run ${parameters.region}']})])
    )
    api.create(task("north", of="bad"))
    made = api.wait_for("Deployment", BAD, lambda _: True, what="the Deployment exists")
    assert made["spec"]["template"]["spec"]["containers"][0]["command"][2] == 'cd "${HOME}" && run north'


@pytest.mark.usefixtures("unharmed")
def test_an_invalid_template_keeps_running_applications_until_it_is_valid(api: Api) -> None:
    api.create(template("bad"))
    api.create(task("north", of="bad"))
    first = api.wait_for("Deployment", BAD, lambda _: True, what="the Deployment exists")["metadata"]
    wait_settled(api)
    # The API server accepts any default; the manager rejects this one.
    wrong = {"parameters": {"region": {"type": "string", "required": True}, "rate": {"type": "number", "default": "x"}}}
    api.patch("ApplicationTemplate", "bad", {"spec": wrong})
    refused = wait_for_false(api, "ApplicationTask", "north", "Accepted", ["'x' is not of type number"])
    assert refused["reason"] == "TemplateInvalid"
    api.wait_for(
        "ApplicationTemplate",
        "bad",
        lambda raw: condition(raw, "Accepted").get("reason") == "TemplateInvalid",
        what="the template's status reports it",
    )
    assert "releaseTime" not in api.get("ApplicationInstance", BAD)["status"]
    api.patch("ApplicationTemplate", "bad", {"spec": {"parameters": {"rate": None}}})
    api.wait_for(
        "ApplicationTask", "north", lambda raw: raw.get("status", {}).get("phase") == "Active", what="it counts again"
    )
    assert api.get("Deployment", BAD)["metadata"]["uid"] == first["uid"]


def test_an_invalid_object_never_reaches_the_manager(api: Api) -> None:
    wrong: dict[str, Any] = template("bad", manifests=[])
    with pytest.raises(ApiError, match=r"spec\.manifests"):
        api.create(wrong)
