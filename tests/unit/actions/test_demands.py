"""A demand keeps its name and round-trips through its task."""

from __future__ import annotations

import dataclasses
import json
import re
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detector.engine.episodes.demands import Demand, from_task, holder_label, to_task
from detector.engine.episodes.record import EpisodeRecord
from wayside.api import ApplicationTask
from wayside.api.applicationtask import HOLDER_LABEL
from wayside.api.operation import Operation

DEMAND = Demand(
    EpisodeRecord(
        id="abc",
        rule="lidar-vehicles-close",
        subject="car1+car2",
        clients=("car1", "car2"),
        element=None,
        onset_time=1_767_225_600_000_000_001,
        start_time=1_767_225_602_000_000_002,
        values={"distance": 149.5, "a": {"client": "car1"}},
        classification={"overarchingPurpose": ["Safety"]},
        rule_digest="0123",
    ),
    action="record",
    template="scene-recorder",
    priority=3,
    parameters={"vehicles": ["car1", "car2"], "rateHz": 10.0},
    detector="intersection-a",
    holder="intersection-a",
    namespace="default",
    operation=Operation.RECONFIGURE,
)
NAME = re.compile(r"[a-z0-9]([-a-z0-9]*[a-z0-9])?")


def changed(**fields: Any) -> Demand:
    """The demand with other fields: its own, or its episode's."""
    of_episode = {name: fields.pop(name) for name in EpisodeRecord.__struct_fields__ if name in fields}
    return dataclasses.replace(DEMAND, episode=msgspec.structs.replace(DEMAND.episode, **of_episode), **fields)


def test_a_demand_round_trips_through_the_json_of_its_task() -> None:
    stored = json.loads(json.dumps(to_task(DEMAND).to_json()))
    assert from_task(ApplicationTask.model_validate(stored)) == DEMAND


def test_the_name_does_not_depend_on_mutable_fields() -> None:
    assert changed(parameters={}, values={}, template="other", rule_digest="9").name == DEMAND.name


@pytest.mark.parametrize(
    "fields", [{"holder": "b"}, {"rule": "r"}, {"action": "x"}, {"subject": "car1"}, {"start_time": 5}]
)
def test_the_name_distinguishes_demands(fields: dict[str, Any]) -> None:
    assert changed(**fields).name != DEMAND.name


def test_parts_of_the_name_do_not_run_into_each_other() -> None:
    assert changed(holder="ab", rule="c" * 60).name != changed(holder="a", rule="b" + "c" * 60).name
    assert changed(action="ab", subject="c").name != changed(action="a", subject="bc").name


@given(st.from_regex(r"[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?", fullmatch=True), st.text(max_size=20))
def test_the_name_is_a_valid_kubernetes_name(rule: str, subject: str) -> None:
    name = changed(rule=rule, subject=subject).name
    assert len(name) <= 63
    assert NAME.fullmatch(name)


def test_a_holder_longer_than_a_label_is_shortened_uniquely() -> None:
    holders = ["d" * 60 + ".pod-1", "d" * 60 + ".pod-2", "d"]
    labels = [holder_label(holder) for holder in holders]
    assert labels[2] == "d"
    assert len(set(labels)) == 3
    assert all(len(label) <= 63 for label in labels)
    assert to_task(changed(holder=holders[0])).metadata.labels[HOLDER_LABEL] == labels[0]


def test_values_that_json_does_not_support_are_omitted() -> None:
    values = {"nan": float("nan"), "none": None, "list": [1.0, float("inf")], "map": {"x": float("-inf"), "y": (1,)}}
    task = to_task(changed(values=values, parameters={"gone": None, "kept": False}))
    assert task.spec.event is not None
    assert task.spec.event.values == {"list": [1.0, None], "map": {"y": [1]}}
    assert task.spec.parameters == {"kept": False}


def test_an_ended_demand_reports_its_end() -> None:
    assert to_task(DEMAND, 1_767_225_604_000_000_003).spec.end_time == "2026-01-01T00:00:04.000000003Z"


def test_a_manually_created_task_is_not_a_demand() -> None:
    task = {"metadata": {"name": "mine"}, "spec": {"templateName": "scene-recorder"}}
    assert from_task(ApplicationTask.model_validate(task | {"kind": "ApplicationTask"})) is None


def test_an_invalid_task_is_rejected_by_field() -> None:
    with pytest.raises(ValueError, match="subject"):
        to_task(changed(subject="x" * 600))
