"""An expression that takes too long affects only its template: objects stay, and other templates are served."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api, ApiError, Object
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import condition, config, end, start_manager, task, template, wait_settled
from tests.cluster.namespaces import new_namespace
from tests.cluster.processes import Processes
from tests.cluster.webhook import Webhook
from tests.worker_jobs import TEXT

LIMIT = ("--expression-cpu-time", "500ms")
BOMB = 'parameters.l.filter(x, parameters.s.matches("([ab]*a[ab]{50}){3}z")).size()'
"""Takes about 15 ms for each item, in C++, while it holds the GIL."""

PARAMETERS = {
    "region": {"type": "string", "default": "north"},
    "l": {"type": "array", "items": "string", "merge": "Union"},
    "s": {"type": "string", "merge": "HighestPriority"},
}
SMALL = {"l": ["0"], "s": "a"}
LARGE = {"l": [str(index) for index in range(2000)], "s": TEXT}


def bomb(name: str = "bomb", *, key: str = "${parameters.region}", **spec: Any) -> Object:
    """A template that renders fast with small values, and takes half a minute with large ones."""
    return template(name, parameters=PARAMETERS, key=key, manifests=[config({"n": f"n=${{{BOMB}}}"})], **spec)


def accepted(api: Api, name: str, status: str) -> str:
    """The message of the template's condition Accepted, once it has this status."""
    found = api.wait_for(
        "ApplicationTemplate",
        name,
        lambda raw: condition(raw, "Accepted").get("status") == status,
        what=f"Accepted of template {name} is {status}",
    )
    message: str = condition(found, "Accepted")["message"]
    return message


def applied(api: Api, name: str, reason: str) -> Object:
    """The instance, once its condition Applied has this reason."""
    return api.wait_for(
        "ApplicationInstance",
        name,
        lambda raw: condition(raw, "Applied").get("reason") == reason,
        what=f"Applied of instance {name} has reason {reason}",
    )


def test_after_a_timeout_running_objects_stay_and_the_template_reports_the_reason(
    api: Api, namespace: str, processes: Processes
) -> None:
    start_manager(processes, namespace, *LIMIT)
    north = instance_name("bomb", "north")
    api.create(bomb())
    api.create(task("good", of="bomb", region="north", **SMALL))
    before = api.wait_for("ConfigMap", f"{north}-config", lambda _: True, what="the ConfigMap exists")
    assert before["data"] == {"n": "n=0"}

    bad = task("bad", of="bomb", region="north", **LARGE)
    bad["spec"]["priority"] = 10
    api.create(bad)
    message = condition(applied(api, north, "ExpressionLimit"), "Applied")["message"]
    assert "rendering this instance took more than 0.5 s of CPU time" in message
    logged = accepted(api, "bomb", "False")
    assert f"rendering instance {north} took more than 0.5 s of CPU time and was stopped: simplify" in logged
    now = api.get("ConfigMap", f"{north}-config")
    assert (now["metadata"]["uid"], now["data"]) == (before["metadata"]["uid"], before["data"])

    end(api, "bad")
    applied(api, north, "Applied")
    accepted(api, "bomb", "True")
    wait_settled(api)


def test_the_tasks_of_another_namespace_are_served_meanwhile(
    api: Api, namespace: str, control_plane: ControlPlane, processes: Processes
) -> None:
    other = control_plane.api(new_namespace(control_plane.api(), "expressions-other"))
    start_manager(processes, namespace, "--namespace", other.namespace, *LIMIT)
    for index in range(8):
        api.create(bomb(f"bomb-{index}"))
        api.create(task(f"task-{index}", of=f"bomb-{index}", region="north", **LARGE))
    other.create(template())
    other.create(task("north"))
    other.wait_for("Deployment", instance_name("app", "north"), lambda _: True, what="the Deployment exists")
    other.wait_for("ApplicationTask", "north", lambda raw: bool(condition(raw, "Accepted")), what="it is accepted")
    for index in range(8):
        applied(api, instance_name(f"bomb-{index}", "north"), "ExpressionLimit")
    wait_settled(other)


def test_a_key_that_times_out_rejects_only_its_task(api: Api, namespace: str, processes: Processes) -> None:
    start_manager(processes, namespace, *LIMIT)
    api.create(bomb(key=f"${{parameters.region}}-${{{BOMB}}}"))
    api.create(task("bad", of="bomb", region="north", **LARGE))
    api.create(task("good", of="bomb", region="south", **SMALL))
    refused = api.wait_for(
        "ApplicationTask",
        "bad",
        lambda raw: condition(raw, "Accepted").get("reason") == "ExpressionLimit",
        what="the task with the large values is rejected",
    )
    assert "took more than 0.5 s of CPU time" in condition(refused, "Accepted")["message"]
    south = f"{instance_name('bomb', 'south-0')}-config"
    api.wait_for("ConfigMap", south, lambda _: True, what="the other one is served")


def test_a_restarted_manager_releases_nothing_before_all_keys_are_computed(
    api: Api, namespace: str, processes: Processes
) -> None:
    manager = start_manager(processes, namespace, *LIMIT)
    pattern = {"region": {"type": "string", "required": True, "pattern": "^[a-z]{1,63}$"}}
    api.create(template(parameters=pattern, linger="0s"))
    regions = [f"region{chr(ord('a') + index)}" for index in range(12)]
    for region in regions:
        api.create(task(region))
    names = [instance_name("app", region) for region in regions]
    made = [api.wait_for("Deployment", name, lambda _: True, what="the Deployment exists") for name in names]
    before = {each["metadata"]["name"]: each["metadata"]["uid"] for each in made}
    wait_settled(api)
    manager.kill9()
    manager.start()
    manager.wait_for_output("watching")
    wait_settled(api)
    assert {name: api.get("Deployment", name)["metadata"]["uid"] for name in names} == before


def test_a_manager_stopped_during_a_long_evaluation_ends_at_once_and_leaves_no_process(
    api: Api, namespace: str, processes: Processes
) -> None:
    manager = start_manager(processes, namespace, "--expression-cpu-time", "1h")
    api.create(bomb())
    accepted(api, "bomb", "True")
    (worker,) = children(manager.pid)
    assert os.sched_getscheduler(worker) == os.SCHED_OTHER, "workers of tests do not run in the idle class"
    api.create(task("bad", of="bomb", region="north", **LARGE))
    api.wait_for("ApplicationTask", "bad", lambda _: True, what="the task exists")
    assert manager.terminate() == 0
    assert not Path(f"/proc/{worker}").exists()


def children(pid: int) -> list[int]:
    """The child processes of a process."""
    return [int(each) for each in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.parametrize("dry_run", [False, True])
def test_admission_rejects_a_template_that_times_out_with_its_own_defaults(
    api: Api, processes: Processes, tmp_path: Path, dry_run: bool
) -> None:
    webhook = Webhook(processes, api, tmp_path / "certificates", options=LIMIT)
    parameters = {
        "l": {"type": "array", "items": "string", "default": LARGE["l"]},
        "s": {"type": "string", "default": TEXT},
    }
    made = template("bomb", parameters=parameters, manifests=[config({"n": f"n=${{{BOMB}}}"}, name="n")])
    del made["spec"]["key"]
    logged = r"spec: the review took more than 0\.5 s of CPU time and was stopped"
    with webhook.requested(), pytest.raises(ApiError, match=logged):
        api.apply(made, dry_run=dry_run)
    assert api.find("ApplicationTemplate", "bomb") is None
