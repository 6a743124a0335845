"""Of two managers one is active; the other takes over only after the first has stopped or lost its Lease."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest

from application_manager.cluster.leadership import DURATION
from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import end, start_manager, task, template, wait_settled
from tests.cluster.faulty_proxy import Proxy, faulty_proxy
from tests.cluster.processes import Process, Processes
from tests.cluster.test_manager_metrics import get, scraped
from tests.cluster.waiting import wait_until
from tests.ports import free_ports

ACTIVE = r"active: holds the Lease"
GIVEN_UP = "requests are still in progress: not releasing the Lease"
LEASE = "application-manager"
REGIONS = [f"r{index}" for index in range(30)]
WAITING = {"232", "281", "22"}
"""The numbers of epoll_wait and epoll_pwait (x86-64), and epoll_pwait (arm64)."""


@dataclass
class Pair:
    """An active manager and its standby, each with its own proxy and a port for its pages."""

    active: Process
    standby: Process
    old: Proxy
    new: Proxy
    ports: list[int]

    def taken_over(self) -> None:
        """Wait until the standby is active."""
        self.standby.wait_for_output(ACTIVE)

    def never_both(self) -> None:
        """Check that the new manager first wrote only after the old one had sent its last write."""
        began = min(each.at for each in self.new.writes())
        assert [each for each in self.old.writes() if each.at >= began] == []


@pytest.fixture
def pair(processes: Processes, namespace: str, control_plane: ControlPlane) -> Iterator[Pair]:
    ports = free_ports(2)
    with ExitStack() as stack:
        (old, first), (new, second) = (stack.enter_context(faulty_proxy(control_plane.kubeconfig)) for _ in range(2))
        active = start_manager(processes, namespace, "--metrics-port", str(ports[0]), kubeconfig=first)
        active.wait_for_output(ACTIVE)
        standby = start_manager(processes, namespace, "--metrics-port", str(ports[1]), kubeconfig=second)
        standby.wait_for_output("standby: manager_")
        yield Pair(active, standby, old, new, ports)
        processes.kill_all()


def demanded(api: Api) -> None:
    """Give the active manager work; return while it is working."""
    api.create(template())
    for region in REGIONS:
        api.create(task(region))
    api.wait_list("Deployment", lambda found: len(found) >= 5, what="the manager has done a part of the work")


def interrupted(api: Api, pair: Pair, how: Callable[[Pair], None]) -> None:
    """Interrupt the active manager during its work; the standby finishes it and creates no object twice."""
    demanded(api)
    how(pair)
    before = uids(api)
    api.create(task("late"))
    end(api, REGIONS[0])
    pair.taken_over()
    wait_settled(api)
    api.wait_list("Deployment", lambda found: len(found) == len(REGIONS), what="exactly the demanded instances run")
    after = uids(api)
    assert {name: uid for name, uid in before.items() if after.get(name, uid) != uid} == {}, (
        "no object was created twice"
    )
    pair.never_both()
    assert api.get("Lease", LEASE)["spec"]["leaseTransitions"] == 1


def uids(api: Api) -> dict[str, str]:
    return {each["metadata"]["name"]: each["metadata"]["uid"] for each in api.list("Deployment")}


def stopped(pair: Pair) -> None:
    """Stop the active manager while its requests are in progress and it waits for answers.

    Between its last check whether it may still write and the system call of the write, nothing can prevent the write
    (see wayside/kubernetes/fence.py): a stop within these microseconds would only show this known limit.
    """
    wait_until(lambda: stopped_in(pair.active.pid), lambda call: call in WAITING, what="it is stopped while it waits")


def stopped_in(pid: int) -> str:
    """Stop the process; return the number of its current system call, or -1. If it is not waiting, it continues for
    now."""
    os.kill(pid, signal.SIGSTOP)
    status = Path(f"/proc/{pid}/status")
    wait_until(status.read_text, lambda text: "State:\tT" in text, what="the process is stopped")
    call = Path(f"/proc/{pid}/syscall").read_text().split()[0]
    if call not in WAITING:
        os.kill(pid, signal.SIGCONT)
    return call


def cut_off(pair: Pair) -> None:
    pair.old.cut = True


def test_the_standby_continues_the_work_of_a_killed_manager(api: Api, pair: Pair) -> None:
    interrupted(api, pair, lambda pair: pair.active.kill9())


def test_a_suspended_manager_writes_nothing_when_it_continues(api: Api, pair: Pair) -> None:
    interrupted(api, pair, stopped)
    for name in (*REGIONS[1:], "late"):
        end(api, name)
    os.kill(pair.active.pid, signal.SIGCONT)
    pair.active.wait_for_output("no longer active|standby: manager_")
    api.wait_list("Deployment", lambda found: not found, what="only demanded instances run")
    wait_settled(api)
    wait_until(
        lambda: get(pair.ports[0], "/readyz")[1], lambda logged: logged.startswith("ok, standby: "), what="a standby"
    )
    pair.never_both()
    # It can take over again, with the changes it has watched meanwhile.
    api.create(task("next"))
    api.wait_list("Deployment", lambda found: len(found) == 1, what="the other manager serves it")
    pair.standby.kill9()
    end(api, "next")
    api.create(task("last"))
    pair.active.wait_for_output(rf"(?s)(no longer active|standby: ).*{ACTIVE}")
    only = [instance_name("app", "last")]
    api.wait_list("Deployment", lambda found: [each["metadata"]["name"] for each in found] == only, what="only it")
    wait_settled(api)


def test_a_manager_that_was_cut_off_returns_as_a_standby(api: Api, pair: Pair) -> None:
    interrupted(api, pair, cut_off)
    pair.active.wait_for_output("no longer active")
    pair.old.cut = False
    pair.active.wait_for_output("standby: manager_")
    api.create(task("later"))
    wait_settled(api)
    pair.never_both()


def test_a_manager_that_is_cut_off_ends_on_sigterm(api: Api, pair: Pair) -> None:
    demanded(api)
    pair.old.cut = True
    assert pair.active.terminate() == 0
    pair.taken_over()
    wait_settled(api)
    pair.never_both()


def test_metrics_and_readiness_show_the_active_manager(api: Api, pair: Pair) -> None:
    holder = api.get("Lease", LEASE)["spec"]["holderIdentity"]
    wait_until(
        lambda: [scraped(port)["active",] for port in pair.ports],
        lambda found: found == [1, 0],
        what="the metrics show the active manager",
    )
    wait_until(lambda: get(pair.ports[0], "/readyz"), lambda found: found == (200, "ok\n"), what="one is active")
    logged = (200, f"ok, standby: {holder} is active\n")
    wait_until(lambda: get(pair.ports[1], "/readyz"), lambda found: found == logged, what="the other is the standby")


def test_a_manager_that_ends_releases_the_lease(api: Api, processes: Processes, namespace: str) -> None:
    manager = start_manager(processes, namespace)
    manager.wait_for_output(ACTIVE)
    assert manager.terminate() == 0
    assert "holderIdentity" not in api.get("Lease", LEASE)["spec"]


def test_a_standby_that_ends_leaves_the_lease_alone(api: Api, pair: Pair) -> None:
    before = api.get("Lease", LEASE)["spec"]["holderIdentity"]
    assert pair.standby.terminate() == 0
    assert api.get("Lease", LEASE)["spec"]["holderIdentity"] == before


def test_a_manually_deleted_manager_lease_is_recreated(api: Api, processes: Processes, namespace: str) -> None:
    manager = start_manager(processes, namespace)
    manager.wait_for_output(ACTIVE)
    uid = api.get("Lease", LEASE)["metadata"]["uid"]
    api.delete("Lease", LEASE)
    api.wait_for("Lease", LEASE, lambda raw: raw["metadata"]["uid"] != uid, what="the Lease exists again")
    api.create(template())
    api.create(task("north"))
    wait_settled(api)


def test_work_in_progress_at_shutdown_is_finished_or_repaired(api: Api, pair: Pair) -> None:
    pair.old.slow = 0.3
    began = 0.0

    def terminated(pair: Pair) -> None:
        nonlocal began
        began = time.monotonic()
        assert pair.active.terminate() == 0

    interrupted(api, pair, terminated)
    taken, last = pair.new.lease_writes()[0].at, pair.old.lease_writes()[-1].at
    if GIVEN_UP in pair.active.output():
        assert taken - last >= DURATION, "the Lease was not released: the standby waited for its end"
    else:
        late = [each for each in pair.old.writes() if each.at > began and not each.status]
        assert late == [], "every write that was sent after the signal was answered"
        assert "released the Lease" in pair.active.output()
