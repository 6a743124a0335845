"""A loaded API server gets few concurrent requests, and none before its Retry-After has passed."""

from __future__ import annotations

import itertools
import time
from concurrent.futures import ThreadPoolExecutor

from tests.cluster.api import Api
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import start_manager, task, template, wait_settled
from tests.cluster.faulty_proxy import ProxiedRequest, faulty_proxy
from tests.cluster.processes import Processes
from tests.cluster.waiting import wait_until
from wayside.kubernetes.pacing import AT_ONCE, MOST_WRITES

WATCHERS = 8  # requests of watches that (re)list, and those about the Lease, are not limited
BURST = 100  # tasks: many times the maximum of concurrent requests
HOLD = 9  # s of the API server's Retry-After
LATE = 3.0  # s that the proxy may see a request late on a busy machine


def test_a_burst_of_tasks_is_served_with_few_concurrent_requests(
    api: Api, processes: Processes, namespace: str, control_plane: ControlPlane
) -> None:
    with faulty_proxy(control_plane.kubeconfig) as (proxy, kubeconfig):
        start_manager(processes, namespace, kubeconfig=kubeconfig).wait_for_output("active: holds the Lease")
        api.create(template())
        # So slow that the maximum of concurrent requests is reached, independent of the machine's speed.
        proxy.most, proxy.slow = 0, max(0.2, 5 * longest(api))
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(api.create, (task(f"t{index}", region=f"r{index % 20}") for index in range(BURST))))
        wait_until(
            lambda: [each.get("status", {}).get("phase") for each in api.list("ApplicationTask")].count("Active"),
            BURST.__eq__,
            what="all tasks have a status and are served",
        )
        assert MOST_WRITES // 2 < proxy.most <= AT_ONCE + WATCHERS
        proxy.slow = 0
        wait_settled(api)


def test_no_request_is_sent_before_the_servers_retry_after_has_passed(
    api: Api, processes: Processes, namespace: str, control_plane: ControlPlane
) -> None:
    with faulty_proxy(control_plane.kubeconfig) as (proxy, kubeconfig):
        manager = start_manager(processes, namespace, kubeconfig=kubeconfig)
        manager.wait_for_output("active: holds the Lease")
        api.create(template())
        once = itertools.count()

        def refuse(method: str, path: str) -> tuple[int, int] | None:
            return (503, HOLD) if method == "PATCH" and "/deployments/" in path and next(once) == 0 else None

        proxy.refuse = refuse
        for index in range(10):
            api.create(task(f"t{index}"))
        api.wait_list("Deployment", lambda found: len(found) == 10, what="all tasks are served in the end")
        wait_settled(api)
        (refused,) = (each for each in proxy.seen if each.refused)
        own = [each for each in proxy.seen if "/leases" not in each.path and not watches(each)]
        served = max(each.at for each in own if each.method == "PATCH" and "/deployments/" in each.path)
        assert served >= refused.at + HOLD
        # Requests that were sent before the answer arrived come first.
        times = sorted(each.at for each in own if refused.at <= each.at <= served)
        assert max(after - before for before, after in itertools.pairwise(times)) >= HOLD - LATE
        assert "Traceback" not in manager.output()


def test_an_api_server_that_rejects_everything_for_a_while_is_waited_for(
    api: Api, processes: Processes, namespace: str, control_plane: ControlPlane
) -> None:
    with faulty_proxy(control_plane.kubeconfig) as (proxy, kubeconfig):
        manager = start_manager(processes, namespace, kubeconfig=kubeconfig)
        manager.wait_for_output("active: holds the Lease")
        api.create(template())
        api.create(task("north"))
        wait_settled(api)
        proxy.refuse = lambda method, path: (429, 1) if "/leases" not in path else None
        began = time.monotonic()
        for index in range(20):
            api.create(task(f"t{index}"))
        wait_until(lambda: [each for each in proxy.seen if each.refused], lambda found: len(found) > 3, what="refused")
        requested = [each for each in proxy.seen if each.at > began and each.refused]
        proxy.refuse = lambda method, path: None
        assert len(requested) < 200, "it does not storm"
        api.wait_list("Deployment", lambda found: len(found) == 21, what="all tasks are served in the end")
        wait_settled(api)
        assert manager.alive


def longest(api: Api) -> float:
    """The duration of the longest of some requests, in seconds."""
    took = []
    for _ in range(10):
        began = time.monotonic()
        api.list("ApplicationTask")
        took.append(time.monotonic() - began)
    return max(took)


def watches(seen: ProxiedRequest) -> bool:
    """Whether the request is kopf's: a watch, or the list before it, which it restarts at any time."""
    return "watch=true" in seen.path or "/namespaces/" not in seen.path
