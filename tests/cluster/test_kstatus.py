"""kubectl, Flux, Argo CD and kstatus derive the right state from the statuses of all five kinds."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import yaml

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api, Object
from tests.cluster.expected_objects import condition, start_manager, task, template
from tests.cluster.manifests import VALID
from tests.cluster.pods import kubelet as playing_kubelet
from tests.cluster.processes import Process, Processes
from tests.kstatus import judged

GUIDE = Path(__file__).parents[2] / "docs" / "gitops.md"
Judge = Callable[[str, str, str], Object]

HEALTH = {"Current": "Healthy", "InProgress": "Progressing", "Failed": "Degraded"}
"""Argo CD's health for each status of kstatus."""

NORTH = instance_name("app", "north")


@pytest.fixture(scope="module")
def health(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The health script of the guide."""
    block = GUIDE.read_text().partition("```yaml\n")[2].partition("```")[0]
    customizations = yaml.safe_load(yaml.safe_load(block)["data"]["resource.customizations"])
    script = tmp_path_factory.mktemp("argo") / "health.lua"
    script.write_text(customizations["wayside.dev/*"]["health.lua"])
    return script


@pytest.fixture
def wait_judged(api: Api, health: Path) -> Judge:
    return partial(_wait_judged, api, health)


def _wait_judged(api: Api, health: Path, kind: str, name: str, verdict: str) -> Object:
    """Wait until kstatus itself and Argo CD's script give the object this status; return it."""

    def judges(raw: Object) -> bool:
        return bool(raw["status"].get("observedGeneration")) and judged([raw], health) == [(verdict, HEALTH[verdict])]

    found = api.wait_for(kind, name, judges, what=f"the kstatus of {kind} {name} is {verdict}")
    ready = condition(found, "Ready")
    if ready:
        assert ready["observedGeneration"] == found["metadata"]["generation"] == found["status"]["observedGeneration"]
    return found


def rule(name: str, when: str = "v > 1") -> Object:
    signals = [{"name": "v", "stream": "speed", "value": "msg.v"}]
    return {
        "apiVersion": "wayside.dev/v1alpha1",
        "kind": "EventRule",
        "metadata": {"name": name},
        "spec": {"signals": signals, "when": when},
    }


def detector(**stream: str) -> Object:
    streams = [{"name": "speed", "key": "vehicles/${client:*}/speed", "encoding": "json"} | stream]
    return {
        "apiVersion": "wayside.dev/v1alpha1",
        "kind": "Detector",
        "metadata": {"name": "town"},
        "spec": {"streams": streams},
    }


def test_a_new_object_is_in_progress_until_the_manager_has_seen_it(api: Api, health: Path) -> None:
    for each in VALID.values():
        made = api.create(each)
        assert judged([made], health) == [("InProgress", "Progressing")], made
        assert (condition(made, "Ready")["status"], condition(made, "Ready")["reason"]) == ("Unknown", "Pending")


@pytest.mark.usefixtures("manager")
def test_usable_rules_detectors_and_templates_are_current_and_unusable_ones_failed(
    api: Api, wait_judged: Judge
) -> None:
    api.create(rule("good"))
    alone = wait_judged("EventRule", "good", "InProgress")
    assert condition(alone, "Ready")["reason"] == "NotSelected"
    api.create(detector())
    api.create(rule("wrong", "speeed > 1"))
    api.create(template())
    api.create(
        template("wrong", manifests=[{"apiVersion": "v1", "kind": "Secret", "metadata": {"name": "${nothing}"}}])
    )
    assert condition(wait_judged("EventRule", "good", "Current"), "Ready")["status"] == "True"
    assert condition(wait_judged("Detector", "town", "Current"), "Ready")["status"] == "True"
    assert condition(wait_judged("ApplicationTemplate", "app", "Current"), "Ready")["status"] == "True"
    for kind, reason in (("EventRule", "RuleInvalid"), ("ApplicationTemplate", "TemplateInvalid")):
        failed = wait_judged(kind, "wrong", "Failed")
        assert {each: condition(failed, each)["reason"] for each in ("Accepted", "Ready", "Stalled")} == dict.fromkeys(
            ("Accepted", "Ready", "Stalled"), reason
        )
    api.patch("EventRule", "wrong", {"spec": {"when": "v > 2"}})
    assert not condition(wait_judged("EventRule", "wrong", "Current"), "Stalled")


@pytest.mark.usefixtures("manager")
def test_a_tasks_verdict_follows_its_application(api: Api, wait_judged: Judge) -> None:
    api.create(template())
    api.create(task("north"))
    wait_judged("ApplicationTask", "north", "InProgress")
    wait_judged("ApplicationInstance", NORTH, "InProgress")
    with playing_kubelet(api):
        wait_judged("ApplicationInstance", NORTH, "Current")
        ready = wait_judged("ApplicationTask", "north", "Current")
    (pod,) = api.list("Pod", labels=f"wayside.dev/instance={NORTH}")
    crashed = [each | {"status": "False"} for each in pod["status"]["conditions"] if each["type"] != "PodScheduled"]
    api.patch("Pod", pod["metadata"]["name"], {"status": {"conditions": crashed}}, subresource="status")
    wait_judged("ApplicationInstance", NORTH, "InProgress")
    broken = wait_judged("ApplicationTask", "north", "InProgress")
    assert (condition(broken, "Applied")["status"], condition(broken, "Ready")["status"]) == ("True", "False")
    assert broken["status"]["readyTime"] == ready["status"]["readyTime"]
    api.create({**task("refused"), "spec": {"templateName": "app", "parameters": {"region": 7}}})
    refused = wait_judged("ApplicationTask", "refused", "Failed")
    assert condition(refused, "Ready")["reason"] == "InvalidParameters"


def test_an_instance_that_cannot_be_applied_is_not_ready_though_its_old_version_runs(
    api: Api, manager: Process, kubelet: None, wait_judged: Judge
) -> None:
    api.create(template())
    api.create(task("north"))
    wait_judged("ApplicationTask", "north", "Current")
    refused = api.get("ApplicationTemplate", "app")["spec"]["manifests"]
    refused[0]["spec"]["selector"] = {"matchLabels": {"app": "another"}}  # immutable, and not its pods' labels
    api.patch("ApplicationTemplate", "app", {"spec": {"manifests": refused}})
    for kind, name in (("ApplicationInstance", NORTH), ("ApplicationTask", "north")):
        found = api.wait_for(
            kind, name, lambda raw: condition(raw, "Applied").get("status") == "False", what=f"{kind} is not applied"
        )
        assert condition(found, "Ready")["status"] == "False", found["status"]
    wait_judged("ApplicationInstance", NORTH, "Failed")
    assert api.get("Deployment", NORTH)["status"]["availableReplicas"] == 1


def test_a_task_whose_instance_is_being_deleted_reports_it(processes: Processes, namespace: str, api: Api) -> None:
    start_manager(processes, namespace)
    api.create(template())
    api.create(task("first", region="north"))
    api.wait_for("Deployment", NORTH, lambda _: True, what="the instance runs")
    api.patch("ApplicationInstance", NORTH, {"metadata": {"finalizers": ["example.dev/keeps-it"]}})
    api.delete("ApplicationInstance", NORTH)
    api.create(task("second", region="north"))
    waiting = api.wait_for(
        "ApplicationTask",
        "second",
        lambda raw: "is being deleted" in condition(raw, "Ready").get("message", ""),
        what="the task's status reports what it waits for",
    )
    assert (waiting["status"]["phase"], condition(waiting, "Applied")["status"]) == ("Pending", "False")
    api.patch("ApplicationInstance", NORTH, {"metadata": {"finalizers": None}})
    api.wait_for(
        "ApplicationTask", "second", lambda raw: condition(raw, "Applied").get("status") == "True", what="it is served"
    )
