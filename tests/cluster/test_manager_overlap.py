"""Two releases with a Lease each manage one namespace: one of them acts, and the other one waits."""

from __future__ import annotations

import time

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import condition, start_manager, task, template, wait_settled
from tests.cluster.faulty_proxy import Proxy, faulty_proxy
from tests.cluster.processes import Processes

OTHER = ("--lease", "other", "--allowed-kinds", "v1/ConfigMap")
"""Options of the second release, which rejects a template with a Deployment."""

WAITS = r"also managed by the manager of the Lease \S+/application-manager, which is older: this manager stands by"
ATTEMPTS, EVERY = 10, 5.0
"""The maximum number of writes of the second manager: ATTEMPTS, and one more every EVERY seconds."""


def statuses(proxy: Proxy) -> int:
    return sum("/applicationtemplates/app/status" in each.path for each in proxy.seen)


def test_the_younger_release_waits_until_the_older_one_stops(
    api: Api, control_plane: ControlPlane, processes: Processes, namespace: str
) -> None:
    with (
        faulty_proxy(control_plane.kubeconfig) as (first, one),
        faulty_proxy(control_plane.kubeconfig) as (second, two),
    ):
        older = start_manager(processes, namespace, kubeconfig=one)
        older.wait_for_output("active: holds the Lease")
        api.wait_for("Lease", "application-manager", lambda _: True, what="the first Lease exists")
        younger = start_manager(processes, namespace, *OTHER, kubeconfig=two)
        younger.wait_for_output("active: holds the Lease")
        began = time.monotonic()
        api.create(template())
        younger.wait_for_output(WAITS)
        for number in range(3):
            api.create(task(f"t{number}"))
            name = instance_name("app", f"t{number}")
            api.wait_for("Deployment", name, lambda _: True, what="the first manager serves the task")
        wait_settled(api)
        reported = api.wait_for(
            "ApplicationTemplate",
            "app",
            lambda raw: raw["status"].get("manager", {}).get("lease", "").endswith("/application-manager"),
            what="its status names the older manager",
        )
        assert condition(reported, "Accepted")["status"] == "True"
        attempts = ATTEMPTS + (time.monotonic() - began) / EVERY
        assert statuses(second) <= attempts
        assert statuses(first) <= 2 * attempts
        assert not [each for each in second.writes() if "/applicationinstances" in each.path]

        older.terminate()
        younger.wait_for_output("this manager becomes active there")
        api.wait_for(
            "ApplicationTemplate",
            "app",
            lambda raw: condition(raw, "Accepted")["status"] == "False",
            what="the second manager validates the template",
        )
        assert api.find("Deployment", instance_name("app", "t0")) is not None, "what runs stays"
