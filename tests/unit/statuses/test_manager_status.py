"""Statuses are current and change rarely: conditions keep their transition times."""

from __future__ import annotations

from typing import Any

import pytest

from application_manager.cache.claim_index import ClaimIndex
from application_manager.cache.store import Entry
from application_manager.core.claims.claims import Claim, claim
from application_manager.core.claims.operations import Verdict, VerdictKind
from application_manager.core.conditions import ConditionState, changed, updated
from application_manager.core.demand.demand import demand, verdict_of
from application_manager.core.statuses.status import InstanceProgress, difference, finished_since, task_status
from tests.unit.manager_objects import NOW, task, template
from wayside.api.applicationtask import TaskPhase
from wayside.times import format_seconds, parse_seconds

COUNTS = Verdict(VerdictKind.COUNTS, "Accepted", "counts", "app")


def logged(status: Any) -> dict[str, str]:
    return {each.type: each.status for each in status.conditions}


def test_a_condition_keeps_its_time_while_its_status_stays() -> None:
    first = updated((), [ConditionState("Ready", False, "NotReady", "0 of 1")], 1, NOW)
    second = updated(first, [ConditionState("Ready", False, "NotReady", "0 of 2")], 2, NOW + 5)
    third = updated(second, [ConditionState("Ready", True, "Ready")], 2, NOW + 9)
    assert second[0].last_transition_time == format_seconds(NOW)
    assert (second[0].message, second[0].observed_generation) == ("0 of 2", 2)
    assert third[0].last_transition_time == format_seconds(NOW + 9)


def test_only_a_changed_status_or_reason_gives_an_event() -> None:
    first = updated((), [ConditionState("Ready", False, "NotReady", "0 of 1")], 1, NOW)
    assert changed((), first) == list(first)
    assert changed(first, updated(first, [ConditionState("Ready", False, "NotReady", "0 of 2")], 2, NOW)) == []


def test_the_conditions_of_a_new_object_come_in_the_order_in_which_they_follow() -> None:
    (pending,) = updated((), [ConditionState("Ready", False, "Pending", unknown=True)], 0, NOW)
    written = updated([pending], [ConditionState("Accepted", True, "A"), ConditionState("Ready", True, "R")], 1, NOW)
    assert [(each.type, each.status) for each in written] == [("Accepted", "True"), ("Ready", "True")]


def test_a_tasks_phases_follow_its_instance() -> None:
    phases = [
        task_status(task("a"), COUNTS, progress, NOW, 0).phase
        for progress in (
            None,
            InstanceProgress("app", False, False),
            InstanceProgress("app", True, False),
            InstanceProgress("app", True, True),
        )
    ]
    assert phases == [TaskPhase.PENDING, TaskPhase.PENDING, TaskPhase.ACTIVE, TaskPhase.READY]


def test_a_task_is_not_ready_before_its_instance_exists_and_keeps_its_state_after_deletion() -> None:
    pending = task_status(task("a"), COUNTS, None, NOW, 0)
    assert logged(pending) == {"Accepted": "True", "Ready": "False"}
    ready = task_status(task("a"), COUNTS, InstanceProgress("app", True, True), NOW, 0)
    later = task_status(task("a").model_copy(update={"status": ready}), COUNTS, None, NOW + 1, 0)
    assert logged(later) == {"Accepted": "True", "Applied": "True", "Ready": "True"}


def test_a_tasks_applied_and_ready_follow_its_instance_and_keep_their_first_time() -> None:
    ready = task_status(task("a"), COUNTS, InstanceProgress("app", True, True), NOW, 0)
    served = task("a").model_copy(update={"status": ready})
    later = task_status(served, COUNTS, InstanceProgress("app", False, False, "broken"), NOW + 1, 0)
    assert logged(later) == {"Accepted": "True", "Applied": "False", "Ready": "False"}
    assert later.phase is TaskPhase.PENDING
    assert later.applied_time == later.ready_time == format_seconds(NOW)
    over = task_status(
        task("a").model_copy(update={"status": later}),
        Verdict(VerdictKind.FINISHED, "Ended", "ended"),
        None,
        NOW + 2,
        0,
    )
    assert logged(over) == {"Accepted": "True", "Finished": "True"}
    assert over.ready_time == format_seconds(NOW)


def test_a_status_is_of_the_generation_that_was_decided_not_of_a_later_one() -> None:
    first, later = (
        task("a").model_copy(update={"metadata": task("a").metadata.model_copy(update={"generation": each})})
        for each in (1, 2)
    )
    claimed = claim(template(), first)
    assert isinstance(claimed, Claim)
    decision = demand([template()], [first], [], {}, NOW).instances["app"]
    found = verdict_of(claimed, {"app": decision}, [])
    assert found is not None
    status = task_status(later, found.verdict, InstanceProgress("app", True, True), NOW, found.generation)
    assert {status.observed_generation, *(each.observed_generation for each in status.conditions)} == {1}


@pytest.mark.parametrize(
    ("kind", "stalled"), [(VerdictKind.REFUSED, True), (VerdictKind.WAITING, False), (VerdictKind.LAPSED, False)]
)
def test_a_task_that_does_not_count_is_not_ready_for_the_same_reason(kind: VerdictKind, stalled: bool) -> None:
    served = task("a").model_copy(
        update={"status": task_status(task("a"), COUNTS, InstanceProgress("app", True, True), NOW, 0)}
    )
    status = task_status(served, Verdict(kind, "Because", "why"), None, NOW + 1, 0)
    found = {each.type: (each.status, each.reason) for each in status.conditions}
    assert found["Ready"] == ("False", "Because")
    assert "Applied" not in found
    assert ("Stalled" in found) is stalled
    again = task_status(
        task("a").model_copy(update={"status": status}), Verdict(kind, "Because", "why"), None, NOW + 9, 0
    )
    assert again == status


def test_a_refused_task_whose_holder_is_lost_counts_the_loss_from_its_beginning() -> None:
    refused = task_status(task("a"), Verdict(VerdictKind.REFUSED, "Conflict", "why"), None, NOW, 0)
    held, lapsed = task("a").model_copy(update={"status": refused}), Verdict(VerdictKind.LAPSED, "HolderLost", "why")
    lost = task_status(held, lapsed, None, NOW + 7200, 0)
    again = task_status(held.model_copy(update={"status": lost}), lapsed, None, NOW + 7300, 0)
    for each in (lost, again):
        (accepted,) = [each for each in each.conditions if each.type == "Accepted"]
        assert (accepted.reason, accepted.last_transition_time) == ("HolderLost", format_seconds(NOW + 7200))


def test_a_tasks_conditions_name_the_trouble_of_its_instance_before_and_after_it_was_ready() -> None:
    pulling = InstanceProgress("app", True, False, "cannot pull image app:1: not found", "ImagePullFailed")
    waiting = task_status(task("a"), COUNTS, pulling, NOW, 0)
    ready = next(each for each in waiting.conditions if each.type == "Ready")
    assert (ready.status, ready.reason, ready.message) == ("False", "ImagePullFailed", pulling.problem)
    served = task("a").model_copy(
        update={"status": task_status(task("a"), COUNTS, InstanceProgress("app", True, True), NOW, 0)}
    )
    later = next(each for each in task_status(served, COUNTS, pulling, NOW, 0).conditions if each.type == "Ready")
    assert (later.status, later.reason, later.message) == ("False", "ImagePullFailed", pulling.problem)


def test_a_finished_task_keeps_its_instance_and_reports_since_when() -> None:
    served = task("a").model_copy(update={"status": task_status(task("a"), COUNTS, None, NOW, 0)})
    done = task_status(served, Verdict(VerdictKind.FINISHED, "Ended", "ended"), None, NOW + 7, 0)
    assert (done.phase, done.instance_name) == (TaskPhase.FINISHED, "app")
    assert finished_since(served.model_copy(update={"status": done})) == NOW + 7
    assert finished_since(served) is None


def test_a_task_that_ends_before_its_status_is_written_still_reports_its_instance() -> None:
    index, name = ClaimIndex(), ("site", "a")
    index.note(name, Entry({}, task("a")), template())
    claimed = index.claim(name)
    assert claimed is not None
    ended = task("a", ended=True)
    index.note(name, Entry({}, ended), template())
    verdict = index.verdict(name)
    assert verdict is not None
    done = task_status(ended, verdict, None, NOW, 0)
    assert (done.phase, done.instance_name) == (TaskPhase.FINISHED, claimed.instance)


def test_a_returning_holder_reopens_its_finished_task() -> None:
    lost = task_status(task("a"), Verdict(VerdictKind.FINISHED, "DetectorLost", "lost"), None, NOW, 0)
    back = task_status(task("a").model_copy(update={"status": lost}), COUNTS, None, NOW + 1, 0)
    assert logged(back)["Finished"] == "False"
    assert finished_since(task("a").model_copy(update={"status": back})) is None


def test_the_difference_is_a_merge_patch() -> None:
    assert difference({"a": 1, "b": 2, "c": 3}, {"a": 1, "b": 5, "d": 6}) == {"b": 5, "c": None, "d": 6}
    assert difference({"a": [1]}, {"a": [1]}) == {}


@pytest.mark.parametrize(
    "text",
    ["2026-05-04T10:20:30Z", "2026-05-04T10:20:30.123Z", "2026-05-04T10:20:30.123456789Z", "2026-05-04T12:20:30+02:00"],
)
def test_times_of_all_precisions_are_read(text: str) -> None:
    assert int(parse_seconds(text)) == 1777890030
