"""An explanation follows the chain from the event to the pods, and gives the result of each task and value."""

from __future__ import annotations

import re
from typing import Any

from application_manager.commands.explanationtext import explanation_text
from application_manager.core.statuses.explaining import NamespaceSnapshot, explanation_of, serving
from application_manager.core.statuses.explanation import Explanation
from tests.guides import guide
from tests.unit.manager_objects import NOW, instance, task, template
from wayside.api import ApplicationInstance, ApplicationTask
from wayside.times import format_seconds

FUSION = {
    "parameters": {
        "region": {"type": "string", "required": True},
        "sources": {"type": "array", "items": "string", "merge": "Union"},
        "rateHz": {"type": "number", "default": 10, "merge": "Max"},
        "quality": {"type": "string", "default": "plain", "merge": "HighestPriority"},
    },
    "key": "${parameters.region}",
}
NAME = "app-3q3f46oudt"
WHY = f"Deployment {NAME} has 0 of 1 pods available: cannot pull image fusion:9: not found"


def emitted(name: str, parameters: dict[str, Any], subject: str = "car1+car2", **more: Any) -> ApplicationTask:
    """A task of a detector, as the manager has accepted it."""
    made = task(name, parameters, holder="town", **more)
    event = {
        "id": name,
        "rule": "scene",
        "action": "fuse",
        "subject": subject,
        "onsetTime": format_seconds(NOW - 2),
        "startTime": format_seconds(NOW),
        "values": {"distance": 142.5},
    }
    raw = made.to_json()
    raw["spec"] |= {"event": event, "requester": {"detectorName": "town", "holder": "town"}}
    raw["status"] = {"phase": "Active", "instanceName": NAME, "observedGeneration": 0}
    return ApplicationTask.model_validate(raw)


def running(**parameters: Any) -> ApplicationInstance:
    made = instance(NAME, key="north", parameters={"region": "north", **parameters}).to_json()
    ready = {
        "type": "Ready",
        "status": "False",
        "reason": "ImagePullFailed",
        "message": WHY,
        "lastTransitionTime": format_seconds(NOW),
    }
    return ApplicationInstance.model_validate(made | {"status": {"phase": "Applied", "conditions": [ready]}})


DEPLOYMENT = {"kind": "Deployment", "metadata": {}, "spec": {"replicas": 1}}
POD = {
    "metadata": {"name": f"{NAME}-abc", "namespace": "site"},
    "spec": {"nodeName": "edge-1", "containers": [{"name": "main", "image": "fusion:9"}]},
    "status": {
        "phase": "Pending",
        "containerStatuses": [
            {"name": "main", "state": {"waiting": {"reason": "ErrImagePull", "message": "not found"}}}
        ],
    },
}

TASKS = [
    emitted("scene-a", {"region": "north", "sources": ["car1"], "rateHz": 20}, priority=3),
    emitted("scene-b", {"region": "north", "sources": ["car2"], "rateHz": 5}, subject="car2+car3"),
    task("by-anna", {"region": "north", "quality": "fine"}),
    task("wrong", {"region": "north", "rateHz": "fast"}),
]


def explained(about: str | None = "scene-a", tasks: Any = TASKS, **more: Any) -> Explanation:
    found = NamespaceSnapshot([template(**FUSION)], tasks, more.pop("instances", [running()]), **more)
    requested = next((each for each in tasks if each.name == about), None)
    return explanation_of(found, task=about, instance=serving(found, requested, NOW) if requested else NAME, now=NOW)


def contributions(explanation: Explanation, parameter: str) -> dict[str, str]:
    (found,) = (each for each in explanation.parameters if each.name == parameter)
    return {each.task: each.effect for each in found.contributions}


def test_the_explanation_lists_contributing_and_outranked_tasks() -> None:
    found = explained()
    values = {each.name: (each.value, each.source) for each in found.parameters}
    assert values == {
        "region": ("north", "tasks"),
        "sources": (["car1", "car2"], "tasks"),
        "rateHz": (20, "tasks"),
        "quality": ("fine", "tasks"),
    }
    assert contributions(found, "rateHz") == {"scene-a": "decides", "scene-b": "outbid"}
    assert contributions(found, "sources") == {"scene-a": "part", "scene-b": "part"}
    assert contributions(found, "quality") == {"by-anna": "decides"}


def test_defaults_and_kept_values_are_distinguished_from_values_of_tasks() -> None:
    by_default = explained("scene-b", [TASKS[1]])
    assert {each.name: each.source for each in by_default.parameters}["quality"] == "default"
    kept = explained(None, [], instances=[running(rateHz=30)])
    assert {each.name: (each.value, each.source) for each in kept.parameters}["rateHz"] == (30, "earlier")
    assert {each.name: each.source for each in kept.parameters}["sources"] == "none"


def test_a_rejected_task_has_no_instance_and_reports_the_reason() -> None:
    found = explained("wrong")
    assert found.task is not None
    assert (found.task.verdict, found.task.reason, found.instance) == ("Refused", "InvalidParameters", None)
    assert "'fast' is not of type number" in found.task.message


def test_a_conflicting_task_is_listed_with_the_tasks_of_the_instance() -> None:
    spec = {**FUSION, "parameters": {**FUSION["parameters"], "model": {"type": "string"}}}  # type: ignore[dict-item]
    tasks = [
        task("first", {"region": "north", "model": "a"}),
        task("other", {"region": "north", "model": "b"}, created=1),
    ]
    found = explanation_of(NamespaceSnapshot([template(**spec)], tasks, []), task="other", instance=NAME, now=NOW)
    assert {each.name: each.reason for each in found.tasks} == {"first": "Accepted", "other": "Conflict"}
    assert contributions(found, "model") == {"first": "decides", "other": "none"}
    assert found.instance is not None
    assert not found.instance.exists


def test_a_holder_that_the_manager_counts_as_lost_is_lost_in_the_explanation() -> None:
    lost = task("a", {"region": "north"}, holder="town", accepted_condition=("False", "HolderLost", NOW - 5))
    found = explained("a", [lost])
    assert found.task is not None
    assert (found.task.verdict, found.task.holder_is_lost) == ("Lapsed", True)


def test_a_missing_template_ends_the_chain() -> None:
    found = explanation_of(NamespaceSnapshot([], [TASKS[0]], []), task="scene-a", instance=None, now=NOW)
    assert found.template.problem == "does not exist"
    assert found.task is not None
    assert found.task.reason == "TemplateNotFound"


def test_objects_and_pods_report_why_they_are_not_ready() -> None:
    found = explained(objects={("apps/v1", "Deployment", NAME): DEPLOYMENT, ("v1", "Service", NAME): None}, pods=[POD])
    assert [(each.kind, each.problem) for each in found.objects] == [
        ("Deployment", "has 0 of 1 pods available"),
        ("Service", "does not exist"),
    ]
    assert [each.problem for each in found.pods] == ["cannot pull image fusion:9: not found"]


def test_the_text_shows_the_effect_of_each_task_and_outranked_values() -> None:
    tasks = [
        *TASKS[:2],
        task("thin", {"rateHz": 2}, operation="Reconfigure"),
        task("rest", {"region": "north"}, operation="Suspend", priority=5),
    ]
    lines = [each.strip() for each in explanation_text(explained("scene-a", tasks)).splitlines()]
    assert "scene-a (scene of car1+car2, Deploy, priority 3) Counts" in lines
    assert "thin (by a person, Reconfigure, priority 0) Counts" in lines
    assert "rest (by a person, Suspend, priority 5) Counts" in lines
    assert "20 of scene-a (car1+car2) is overridden: a Reconfigure task overrides it" in lines
    assert "2 of thin is used" in lines
    assert not [each for each in lines if " of rest " in each], "its parameters only select its instance"
    of_all = explanation_text(explained("thin", tasks)).splitlines()
    assert "instances: all instances of the template" in of_all


def test_an_instance_without_a_place_waits_before_any_status_has_it() -> None:
    one, two = task("one", {"region": "north"}), task("two", {"region": "south"}, created=1)
    found = NamespaceSnapshot([template(**FUSION, maxInstances=1)], [one, two], [running()])
    reported = explanation_of(found, task="two", instance=serving(found, two, NOW), now=NOW)
    assert reported.task is not None
    assert (reported.task.verdict, reported.task.reason) == ("Waiting", "LimitReached")


def test_a_capped_sum_reports_its_uncapped_value() -> None:
    spec = {"parameters": {"uplink": {"type": "number", "maximum": 100, "merge": "Sum"}}}
    tasks = [task("one", {"uplink": 60}), task("two", {"uplink": 70})]
    found = NamespaceSnapshot([template(**spec)], tasks, [])
    reported = explanation_text(explanation_of(found, task="one", instance=serving(found, tasks[0], NOW), now=NOW))
    assert "  uplink = 100 (merge Sum): the sum of 2 values, 130, is capped at the maximum of 100\n" in reported


def test_ended_tasks_do_not_push_live_ones_out_of_the_limited_output() -> None:
    over = [emitted(f"over-{number:02}", {"region": "north"}, ended=True, created=-60) for number in range(30)]
    reported = explanation_text(explained(None, [*over, TASKS[0]])).splitlines()
    listed = reported.index(f"tasks of instance {NAME}")
    assert reported[listed + 1].startswith("  scene-a (scene of car1+car2, Deploy")
    assert "  and 11 more: -o json lists all" in reported


def test_the_guide_shows_the_printed_explanation() -> None:
    lease = {"spec": {"renewTime": format_seconds(NOW - 2.5)}}
    found = explained(objects={("apps/v1", "Deployment", NAME): DEPLOYMENT}, pods=[POD], leases={"town": lease})
    shown = re.search(r"```console\n\$ application-manager explain scene-a\n(.*?)```", guide("manager"), re.DOTALL)
    assert shown is not None
    assert shown[1] == explanation_text(found)


def test_an_explanation_as_json_reads_back() -> None:
    found = explained(pods=[POD])
    assert Explanation.model_validate(found.to_json()) == found
