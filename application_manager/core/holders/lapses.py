"""Demands that expire: those of holders whose Lease is no longer renewed. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from application_manager.core.claims.claims import Claim
from application_manager.core.claims.operations import Standing, Verdict
from application_manager.core.holders.leases import LeaseView
from wayside.api import ApplicationTask, ApplicationTemplate
from wayside.api.applicationtemplate import Lifecycle, LossPolicy
from wayside.kubernetes.leases import lease_name
from wayside.times import parse_seconds

HOLDER_LOST = "HolderLost"
FINISH_LOST_AFTER = 3600.0  # s that a holder may be lost before its tasks are finished


def live_claims(
    ordered: Iterable[Claim], template: ApplicationTemplate | None, leases: Mapping[str, LeaseView], now: float
) -> tuple[list[Claim], dict[str, Verdict], list[float]]:
    """The claims whose holders are not lost, the verdicts of the others, and when any of this changes by itself.

    `leases` by holder, one that is missing is not lost; `now` and what is returned in seconds since 1970.
    """
    lifecycle = template.spec.lifecycle if template else Lifecycle()
    live: list[Claim] = []
    verdicts: dict[str, Verdict] = {}
    changes: list[float] = []
    for each in ordered:
        lapse, change = _lapse(each.task, lifecycle, leases, now)
        if change is not None:
            changes.append(change)
        if lapse is None:
            live.append(each)
        else:
            verdicts[each.task.name] = lapse
    return live, verdicts, changes


def _lapse(
    task: ApplicationTask, lifecycle: Lifecycle, leases: Mapping[str, LeaseView], now: float
) -> tuple[Verdict | None, float | None]:
    """The task's verdict where its holder is lost, None where it counts; and when that changes by itself.

    The loss in the status survives our own restart: the holder counts as lost until its Lease is seen to be
    renewed, since a new manager has not observed anything yet.
    """
    holder = task.spec.requester.holder
    view = leases.get(holder) if holder else None
    if holder is None or view is None or lifecycle.on_detector_loss.policy is LossPolicy.HOLD:
        return None, None
    limit = view.duration + lifecycle.on_detector_loss.after.seconds
    lost_since = _lost_since(task)
    if view.unchanged < limit and (view.renewed or lost_since is None):
        return None, now + limit - view.unchanged
    since = now if lost_since is None else lost_since
    if now - since >= FINISH_LOST_AFTER:
        message = f"holder {holder} has been lost for over an hour"
        return Verdict(Standing.FINISHED, "DetectorLost", message), None
    message = (
        f"holder {holder} is lost: its Lease {lease_name(holder)} was not renewed for {limit:g} s; the demand "
        "counts again once the Lease is renewed"
    )
    return Verdict(Standing.LAPSED, HOLDER_LOST, message), since + FINISH_LOST_AFTER


def _lost_since(task: ApplicationTask) -> float | None:
    for condition in task.status.conditions if task.status else ():
        if condition.type == "Accepted" and condition.status == "False" and condition.reason == HOLDER_LOST:
            return parse_seconds(condition.last_transition_time)
    return None
