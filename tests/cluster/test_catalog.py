"""`detector catalog --cluster` lists the EventRules of a namespace as the API server has them."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

from tests import programs
from tests.cluster.api import Api, Object
from tests.cluster.controlplane import ControlPlane

RARE = {"incidence": ["Rare"], "typeOfAction": ["Notification"]}


def rule(name: str, classification: dict[str, list[str]] | None) -> Object:
    spec = {"when": "true", **({"classification": classification} if classification else {})}
    return {"apiVersion": "wayside.dev/v1alpha1", "kind": "EventRule", "metadata": {"name": name}, "spec": spec}


def catalog(kubeconfig: Path, namespace: str, *options: str) -> subprocess.CompletedProcess[str]:
    command = ("detector", "catalog", "--cluster", "--namespace", namespace, *options)
    return programs.run(*command, environment={"KUBECONFIG": str(kubeconfig)})


def test_the_rules_of_the_namespace_are_listed_and_those_of_others_are_not(
    control_plane: ControlPlane, api: Api, namespace: str
) -> None:
    api.create(rule("battery", RARE))
    api.create(rule("plain", None))
    answer = catalog(control_plane.kubeconfig, namespace, "--format", "json")
    assert answer.returncode == 0, answer.stderr
    document = json.loads(answer.stdout)
    place = f"namespace {namespace}"
    assert document["rules"] == [
        {"name": "battery", "place": place, "classification": RARE},
        {"name": "plain", "place": place},
    ]
    listed = {
        value["name"]: value["rules"]
        for dimension in document["dimensions"]
        if dimension["name"] == "incidence"
        for value in dimension["values"]
    }
    assert listed == {"Frequent": [], "Common": [], "Rare": [0], "Unexpected": []}
    assert answer.stderr == "2 of 2 rules\n"
    elsewhere = catalog(control_plane.kubeconfig, f"{namespace}-elsewhere", "--format", "json")
    assert json.loads(elsewhere.stdout)["rules"] == []


def test_a_rule_that_cannot_be_read_is_reported_and_the_others_are_listed(
    control_plane: ControlPlane, api: Api, namespace: str
) -> None:
    api.create(rule("battery", RARE))
    broken = rule("broken", RARE)
    broken["spec"]["actions"] = [{"name": "a", "deploy": {"templateName": "t", "parameters": {"not-an-identifier": 1}}}]
    api.create(broken)
    answer = catalog(control_plane.kubeconfig, namespace, "--only", "incidence=Rare", "--format", "json")
    assert answer.returncode == 0, answer.stderr
    assert [each["name"] for each in json.loads(answer.stdout)["rules"]] == ["battery"]
    reported, summary = answer.stderr.splitlines()
    assert reported.startswith(
        "left out, because it cannot be read: EventRule broken: spec.actions[0].deploy.parameters"
    )
    assert summary == "1 of 1 rules"


def test_a_user_without_the_right_to_list_rules_gets_an_error_of_one_line(
    control_plane: ControlPlane, namespace: str
) -> None:
    stranger = control_plane.kubeconfig_with_token("catalog-stranger", "no-such-token")
    answer = catalog(stranger, namespace)
    assert answer.returncode == 2
    assert answer.stdout == ""
    assert answer.stderr == (
        f"detector: cannot list the EventRules of namespace {namespace}: Unauthorized (HTTP 401). "
        "Check that KUBECONFIG points to the right cluster, and that its account may list "
        "eventrules.wayside.dev there\n"
    )
