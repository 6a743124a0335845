"""The number of the manager's requests to the API server, counted by a proxy between the two."""

from __future__ import annotations

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import condition, has_status, start_manager, task, template, wait_settled
from tests.cluster.faulty_proxy import ProxiedRequest, Proxy, faulty_proxy
from tests.cluster.processes import Processes
from tests.cluster.waiting import wait_until

MANY = 5
QUICK = 1.5
"""The maximum number of seconds from a Deployment to the first status, below the manager's wait for the controllers:
after it, there are two statuses."""
BESIDE = 4
"""Requests for a task with its own instance, in addition to the two applies: a read, two statuses, an Event."""

LISTS_AND_LEASES = ("watch=true", "limit=", "/leases", "/selfsubjectaccessreviews")


def about_tasks(proxy: Proxy, since: int) -> list[ProxiedRequest]:
    """The requests without lists, whose number depends on time and not on tasks, and without those about Leases."""
    return [each for each in proxy.seen[since:] if not any(part in each.path for part in LISTS_AND_LEASES)]


def is_quick(seen: list[ProxiedRequest]) -> bool:
    """Whether the controllers had looked at the Deployment before the first status of its instance."""
    applied = next(each.at for each in applies(seen) if "/deployments/" in each.path)
    first = next(each.at for each in seen if "/applicationinstances/" in each.path and "/status" in each.path)
    return first - applied < QUICK


def applies(seen: list[ProxiedRequest]) -> list[ProxiedRequest]:
    return [each for each in seen if each.method == "PATCH" and "force=true" in each.path]


def test_a_task_with_an_instance_of_its_own_takes_two_applies_and_four_other_requests(
    api: Api, control_plane: ControlPlane, processes: Processes, namespace: str
) -> None:
    with faulty_proxy(control_plane.kubeconfig) as (proxy, kubeconfig):
        start_manager(processes, namespace, kubeconfig=kubeconfig)
        api.create(template())
        api.wait_for("ApplicationTemplate", "app", lambda raw: bool(condition(raw, "Accepted")), what="it is known")
        api.create(task("warm"))
        wait_settled(api)
        wait_until(lambda: api.get("ApplicationTemplate", "app"), lambda raw: raw["status"]["instances"] == 1, what="1")
        counted: list[list[ProxiedRequest]] = []
        for number in range(10 * MANY):
            wait_settled(api)
            since = len(proxy.seen)
            api.create(task(f"t{number}"))
            name = instance_name("app", f"t{number}")
            api.wait_for("ApplicationInstance", name, has_status, what="the instance has the condition")
            api.wait_for("ApplicationTask", f"t{number}", has_status, what="the task has it too")
            wait_settled(api)
            seen = [each for each in about_tasks(proxy, since) if "/applicationtemplates/" not in each.path]
            if is_quick(seen):
                counted.append(seen)
            if len(counted) == MANY:
                break
        assert len(counted) == MANY, "the controllers are too slow for a count"
        assert [len(applies(seen)) for seen in counted] == [2] * MANY
        others = [each for seen in counted for each in seen if each not in applies(seen)]
        assert len(others) <= BESIDE * MANY, "\n".join(f"{each.method} {each.path}" for each in others)


def test_repeated_events_are_one_event_with_a_series(api: Api, processes: Processes, namespace: str) -> None:
    start_manager(processes, namespace)
    api.create(template())
    api.create(task("north"))
    wait_settled(api)
    north = instance_name("app", "north")
    for times in range(1, 4):
        for value, status in (("anna", "True"), (None, "False")):
            api.patch("ApplicationInstance", north, {"metadata": {"annotations": {"wayside.dev/pause": value}}})
            api.wait_for(
                "ApplicationInstance",
                north,
                lambda raw, status=status: condition(raw, "Paused").get("status") == status,
                what=f"it is paused or not, for the {times}. time",
            )

    def paused() -> list[int]:
        events = [each for each in api.list("Event.events.k8s.io") if each["reason"] == "Paused"]
        return [each.get("series", {}).get("count", 1) for each in events]

    wait_until(paused, lambda found: found == [2], what="one Event, whose series was begun by the first repetition")
