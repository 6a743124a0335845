"""Demands last as long as their holder's Lease is renewed, as far as the manager can see."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import pytest

from application_manager.core.claims.claims import instance_name
from application_manager.core.holders.leases import LeaseView
from tests.cluster.api import Api, Object
from tests.cluster.expected_objects import condition, task, template, wait_settled
from tests.cluster.processes import Process
from tests.cluster.repeating import repeated
from tests.cluster.waiting import wait_until
from wayside.kubernetes.leases import HOLDER_LEASE_LABEL

NORTH = instance_name("app", "north")
LOST = {"det": LeaseView(1000.0)}


LONG = 600  # s: outlasts the test
SHORT = 10  # s: short enough to wait for, long compared with the half second between renewals


@pytest.fixture
def renew(api: Api) -> Callable[..., None]:
    """Renews the Lease of a holder, by default `det`, for a number of seconds; that of `det` begins with a long one.

    The Lease of `old` has no label, like those of detectors of older releases.
    """
    minutes = itertools.count()

    def renew(duration: int, holder: str = "det") -> None:
        spec = {
            "holderIdentity": holder,
            "leaseDurationSeconds": duration,
            "renewTime": "2020-01-01T{:02}:{:02}:00.000000Z".format(*divmod(next(minutes), 60)),  # its clock is behind
        }
        metadata: Object = {"name": f"wayside-{holder}"}
        if holder != "old":
            metadata["labels"] = {HOLDER_LEASE_LABEL: "true"}
        api.apply({"apiVersion": "coordination.k8s.io/v1", "kind": "Lease", "metadata": metadata, "spec": spec})

    renew(LONG)
    return renew


def lossy(policy: str = "Release") -> Any:
    return template(lifecycle={"linger": "0s", "onDetectorLoss": {"policy": policy, "after": "1s"}})


def reason(raw: Any) -> Any:
    return condition(raw, "Accepted").get("reason")


def test_the_demand_of_a_lost_holder_is_released_and_counts_again_when_it_returns(
    api: Api, manager: Process, renew: Callable[..., None]
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
    assert len(api.list("Deployment")) == 1, "a user's task never expires"

    manager.kill9()  # the loss is stored: a new manager has not observed any Lease, but starts nothing
    manager.start()
    manager.wait_for_output("watching")
    wait_settled(api, lost=LOST)
    assert api.find("Deployment", NORTH) is None

    def again() -> Any:
        renew(LONG)  # repeatedly: the first Lease that the new manager reads is not a renewal to it
        return api.find("Deployment", NORTH)

    wait_until(again, bool, what="the demand counts again")
    api.wait_for("ApplicationTask", "north", lambda raw: reason(raw) == "Accepted", what="the task is accepted")


def test_a_lease_that_is_renewed_keeps_the_demand(api: Api, manager: Process, renew: Callable[..., None]) -> None:
    api.create(lossy())
    renew(LONG, "silent")
    renew(LONG, "old")
    for holder in ("det", "old", "silent", "nobody"):
        api.create(task(holder, holder=holder))
        # A holder without a Lease is lost only after 15 s and one more.
        api.wait_for("ApplicationTask", holder, lambda raw: reason(raw) == "Accepted", what="it counts")
    name = instance_name("app", "det")
    uid = api.wait_for("Deployment", name, lambda _: True, what="the Deployment exists")["metadata"]["uid"]

    def renew_both() -> None:
        renew(SHORT)
        renew(SHORT, "old")

    with repeated("renewing", renew_both, 0.5):
        renew(SHORT, "silent")  # the last renewal
        api.wait_for("ApplicationTask", "silent", lambda raw: reason(raw) == "HolderLost", what="it is lost")
        for holder in ("det", "old"):
            assert reason(api.get("ApplicationTask", holder)) == "Accepted"
    assert api.get("Deployment", name)["metadata"]["uid"] == uid


def test_policy_hold_keeps_the_demands_of_a_lost_holder(api: Api, manager: Process, renew: Callable[..., None]) -> None:
    api.create(lossy("Hold"))
    api.create({**lossy(), "metadata": {"name": "other"}})
    api.create(task("north", holder="det"))
    api.create(task("witness", of="other", holder="det"))
    api.wait_for("Deployment", NORTH, lambda _: True, what="the Deployment exists")
    renew(1)
    api.wait_for("ApplicationTask", "witness", lambda raw: reason(raw) == "HolderLost", what="the holder is lost")
    assert reason(api.get("ApplicationTask", "north")) == "Accepted"
    assert api.find("Deployment", NORTH) is not None
