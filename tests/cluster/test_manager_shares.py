"""Namespaces take turns: a backlog in one does not delay the tasks and statuses of others.

Resource versions give the order of writes: they increase over all objects of the cluster. All objects exist before the
manager starts, so they are all enqueued at once, those of the small namespace last.
"""

from __future__ import annotations

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import condition, config, end, start_manager, task, template
from tests.cluster.namespaces import new_namespace
from tests.cluster.processes import Processes

MANY = 150
LIMITED = "*/det:max-tasks=1,max-priority=10,operations=Deploy+Reconfigure"
AHEAD = MANY // 2
"""The maximum number of the flood's objects written before the last one; without fair turns, all of them would be."""


def test_a_flood_in_one_namespace_delays_neither_what_another_applies_nor_its_statuses(
    api: Api, namespace: str, control_plane: ControlPlane, processes: Processes
) -> None:
    small = control_plane.api(new_namespace(control_plane.api(), "zz-small"))  # listed after the other namespace
    refused = {"of": "missing"}
    made = template(manifests=[config({"region": "${parameters.region}"})])
    for each, count in ((api, MANY), (small, 1)):
        each.create(made)
        for index in range(count):
            each.create(task(f"served-{index:03}"))
            each.create(task(f"refused-{index:03}", **refused))
    start_manager(processes, namespace, "--namespace", small.namespace)

    name = f"{instance_name('app', 'served-000')}-config"
    one = small.wait_for("ConfigMap", name, lambda _: True, what="the ConfigMap exists")
    many = api.wait_list(
        "ConfigMap", lambda found: sum(_is_ours(each) for each in found) == MANY, what="all ConfigMaps exist"
    )
    before = [each for each in many if _is_ours(each) and _version(each) < _version(one)]
    assert len(before) < AHEAD

    reported = small.wait_for(
        "ApplicationTask", "refused-000", lambda raw: bool(condition(raw, "Accepted")), what="the task has a status"
    )
    others = api.wait_list(
        "ApplicationTask",
        lambda found: all(condition(each, "Accepted") for each in found if _is_refused(each)),
        what="all rejected tasks have a status",
    )
    ahead = [each for each in others if _is_refused(each) and _version(each) < _version(reported)]
    assert len(ahead) < AHEAD


def test_tasks_beyond_the_budget_of_their_namespace_wait_until_older_ones_end(
    api: Api, namespace: str, processes: Processes
) -> None:
    start_manager(processes, namespace, "--max-tasks", "2")
    api.create(template())
    for name in ("a", "b", "c"):
        api.create(task(name))
        _wait_accepted(api, name, ("LimitReached" if name == "c" else "Accepted"))
    waiting = api.get("ApplicationTask", "c")["status"]
    assert waiting["phase"] == "Waiting"
    assert "the limit of 2 unfinished tasks" in waiting["message"]
    assert api.find("Deployment", instance_name("app", "c")) is None
    end(api, "a")
    api.wait_for("Deployment", instance_name("app", "c"), lambda _: True, what="the next task is served")
    _wait_accepted(api, "c", "Accepted")


def test_a_holder_is_limited_to_its_budget_and_people_are_not(api: Api, namespace: str, processes: Processes) -> None:
    start_manager(processes, namespace, "--holder-policy", LIMITED)
    api.create(template())
    urgent, stopping = task("urgent", holder="det"), task("stopping", holder="det", region="first")
    api.create({**urgent, "spec": {**urgent["spec"], "priority": 11}})
    api.create({**stopping, "spec": {**stopping["spec"], "operation": "Suspend"}})
    for name, reported in (("urgent", "spec.priority: 11 is above 10"), ("stopping", "spec.operation: Suspend")):
        _wait_accepted(api, name, "NotAllowed")
        assert reported in api.get("ApplicationTask", name)["status"]["message"]
    api.create(task("first", holder="det"))  # rejected tasks do not count towards the budget
    _wait_accepted(api, "first", "Accepted")
    api.create(task("second", holder="det"))
    _wait_accepted(api, "second", "LimitReached")
    api.create(task("other", holder="another"))
    _wait_accepted(api, "other", "Accepted")
    person = task("person", region="first")
    api.create({**person, "spec": {**person["spec"], "operation": "Suspend", "priority": 1000}})
    deployment = instance_name("app", "first")
    api.wait_for("Deployment", deployment, lambda raw: raw["spec"]["replicas"] == 0, what="a user suspends it")
    api.delete("ApplicationTask", "first")
    _wait_accepted(api, "second", "Accepted")


def _wait_accepted(api: Api, name: str, reason: str) -> None:
    api.wait_for(
        "ApplicationTask", name, lambda raw: condition(raw, "Accepted").get("reason") == reason, what=f"it is {reason}"
    )


def _version(raw: dict[str, dict[str, str]]) -> int:
    return int(raw["metadata"]["resourceVersion"])


def _is_ours(raw: dict[str, dict[str, str]]) -> bool:
    return raw["metadata"]["name"].endswith("-config")


def _is_refused(raw: dict[str, dict[str, str]]) -> bool:
    return raw["metadata"]["name"].startswith("refused")
