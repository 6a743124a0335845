"""Namespaces take turns: whatever waits in one, the others' tasks are applied, and have their statuses, in between.

Versions tell the order of writes: they grow over all objects of the cluster. Everything is there before the manager
starts, so it is all enqueued at once, that of the small namespace last.
"""

from __future__ import annotations

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api
from tests.cluster.controlplane import ControlPlane
from tests.cluster.managed_world import config, start_manager, task, template
from tests.cluster.namespaces import new_namespace
from tests.cluster.processes import Processes

MANY = 150
AHEAD = MANY // 2
"""Maximum number of the many that may be written before the last one; without turns it would be all."""


def test_a_flood_in_one_namespace_delays_neither_what_another_applies_nor_its_statuses(
    api: Api, namespace: str, control_plane: ControlPlane, processes: Processes
) -> None:
    small = control_plane.api(new_namespace(control_plane.api(), "zz-small"))  # listed after the other
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

    told = small.wait_for("ApplicationTask", "refused-000", lambda raw: "status" in raw, what="the task has a status")
    others = api.wait_list(
        "ApplicationTask",
        lambda found: all("status" in each for each in found if each["metadata"]["name"].startswith("refused")),
        what="all tasks that are refused have a status",
    )
    ahead = [
        each for each in others if each["metadata"]["name"].startswith("refused") and _version(each) < _version(told)
    ]
    assert len(ahead) < AHEAD


def _version(raw: dict[str, dict[str, str]]) -> int:
    return int(raw["metadata"]["resourceVersion"])


def _is_ours(raw: dict[str, dict[str, str]]) -> bool:
    return raw["metadata"]["name"].endswith("-config")
