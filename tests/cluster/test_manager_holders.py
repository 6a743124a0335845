"""Demands last as long as their holder's Lease is renewed, as far as the manager can see."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from typing import Any

import pytest

from application_manager.core.claims.claims import instance_name
from application_manager.core.holders.leases import LeaseView
from tests.cluster.api import Api
from tests.cluster.managed_world import condition, task, template, wait_settled
from tests.cluster.processes import Process
from tests.cluster.waiting import wait_until

NORTH = instance_name("app", "north")
LOST = {"det": LeaseView(1000.0)}


LONG = 600  # s: for as long as the test looks


@pytest.fixture
def renew(api: Api) -> Callable[[int], None]:
    """Renews the Lease of the holder `det` for so many seconds; it begins with a long one."""
    minutes = itertools.count()

    def renew(duration: int) -> None:
        spec = {
            "holderIdentity": "det",
            "leaseDurationSeconds": duration,
            "renewTime": "2020-01-01T{:02}:{:02}:00.000000Z".format(*divmod(next(minutes), 60)),  # a clock far behind
        }
        metadata = {"name": "wayside-det"}
        api.apply({"apiVersion": "coordination.k8s.io/v1", "kind": "Lease", "metadata": metadata, "spec": spec})

    renew(LONG)
    return renew


def lossy(policy: str = "Release") -> Any:
    return template(lifecycle={"linger": "0s", "onDetectorLoss": {"policy": policy, "after": "1s"}})


def reason(raw: Any) -> Any:
    return condition(raw, "Accepted").get("reason")


def test_a_lost_holder_releases_and_a_returning_one_counts_again(
    api: Api, manager: Process, renew: Callable[[int], None]
) -> None:
    api.create(lossy())
    api.create(task("north", holder="det"))
    api.create(task("person"))
    api.wait_for("Deployment", NORTH, lambda _: True, what="the Deployment exists")
    renew(1)
    lost = api.wait_for("ApplicationTask", "north", lambda raw: reason(raw) == "HolderLost", what="the holder is lost")
    assert "wayside-det was not renewed for 2 s" in condition(lost, "Accepted")["message"]
    assert lost["status"]["phase"] == "Lapsed"
    api.wait_gone("Deployment", NORTH)
    wait_settled(api, lost=LOST)
    assert len(api.list("Deployment")) == 1, "a person's task never lapses"

    manager.kill9()  # the loss is remembered: a new manager has not observed anything, and yet starts nothing
    manager.start()
    manager.wait_for_output("watching")
    wait_settled(api, lost=LOST)
    assert api.find("Deployment", NORTH) is None

    def again() -> Any:
        renew(LONG)  # as a holder does all the time: the first that the new manager sees of a Lease is no renewal to it
        return api.find("Deployment", NORTH)

    wait_until(again, bool, what="the demand counts again")
    api.wait_for("ApplicationTask", "north", lambda raw: reason(raw) == "Accepted", what="the task is told")


def test_a_lease_that_is_renewed_keeps_the_demand(api: Api, manager: Process, renew: Callable[[int], None]) -> None:
    api.create(lossy())
    api.create(task("north", holder="det"))
    api.create(task("unknown", holder="nobody"))
    # There is patience with one that has no Lease: for 15 s, and one more.
    api.wait_for("ApplicationTask", "unknown", lambda raw: reason(raw) == "Accepted", what="it counts")
    uid = api.wait_for("Deployment", NORTH, lambda _: True, what="the Deployment exists")["metadata"]["uid"]
    began = time.monotonic()
    while time.monotonic() - began < 25:  # s: without the renewals, the holder would be lost after 16
        renew(15)
        api.wait_for("Deployment", NORTH, lambda raw: raw["metadata"]["uid"] == uid, what="it stays")
        with pytest.raises(TimeoutError):  # half a second goes by, in which nothing may change
            api.wait_gone("Deployment", NORTH, timeout=0.5)
    assert reason(api.get("ApplicationTask", "north")) == "Accepted"


def test_policy_hold_keeps_the_demands_of_a_lost_holder(
    api: Api, manager: Process, renew: Callable[[int], None]
) -> None:
    api.create(lossy("Hold"))
    api.create({**lossy(), "metadata": {"name": "other"}})
    api.create(task("north", holder="det"))
    api.create(task("witness", of="other", holder="det"))
    api.wait_for("Deployment", NORTH, lambda _: True, what="the Deployment exists")
    renew(1)
    api.wait_for("ApplicationTask", "witness", lambda raw: reason(raw) == "HolderLost", what="the holder is lost")
    assert reason(api.get("ApplicationTask", "north")) == "Accepted"
    assert api.find("Deployment", NORTH) is not None
