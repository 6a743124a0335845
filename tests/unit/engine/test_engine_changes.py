"""The engine: demands of open episodes, and the effect of rule changes on them."""

from __future__ import annotations

from typing import Any

import pytest

from tests.driving import SPEED, Drive, a_deploy, a_detector, at, place, speed
from tests.unit.engine.rules import change, demanded, near, speeding


@pytest.mark.parametrize(
    "spec",
    [
        {"when": "speed > 11"},
        {"until": "speed < 3"},
        {"for": "1s"},
        {"signals": [SPEED | {"over": "3s"}]},
        {"scope": {"client": {"where": "true"}}},
        {"enabled": False},
    ],
)
def test_a_rule_with_a_changed_meaning_ends_its_episodes(spec: dict[str, Any]) -> None:
    drive = Drive(a_detector(), speeding(actions=[a_deploy("x")]), speeding("other"))
    drive.take(speed(0.5, 20), until=1.5)
    version = drive.engine.demands_version
    assert change(drive, speeding(actions=[a_deploy("x")], **spec), speeding("other")) == ["r car RuleChanged 1.5"]
    assert drive.engine.demands() == {}
    assert drive.engine.demands_version != version


def test_a_removed_rule_ends_its_episodes() -> None:
    drive = Drive(a_detector(), speeding(), speeding("other"))
    drive.take(speed(0.5, 20), speed(0.6, 20, "bus"), until=1.5)
    assert change(drive, speeding("other")) == ["r bus RuleChanged 1.5", "r car RuleChanged 1.5"]
    assert drive.take(until=3) == []


@pytest.mark.parametrize(
    "spec",
    [
        {"cooldown": "1m"},
        {"unknownTimeout": "1m"},
        {"description": "x"},
        {"evaluation": {"every": "2s"}},
        {"actions": []},
        {"dryRun": True},
        {"classification": {"incidence": ["Rare"]}},
    ],
)
def test_other_changes_leave_open_episodes_open(spec: dict[str, Any]) -> None:
    drive = Drive(a_detector(), speeding(actions=[a_deploy("x")]))
    drive.take(speed(0.5, 20), until=1.5)
    assert change(drive, speeding(**{"actions": [a_deploy("x")], **spec})) == []
    assert drive.take(speed(3.5, 5), until=4) == ["r car Until 4"]


def test_changed_actions_are_rendered_for_open_episodes_with_the_values_of_their_start() -> None:
    fast = {"fast": "${speed}"}
    drive = Drive(
        a_detector(),
        speeding(actions=[a_deploy("same", parameters=fast), a_deploy("gone"), a_deploy("changed", "old")]),
    )
    drive.take(speed(0.5, 20), until=1.5)
    drive.take(speed(1.6, 30), until=2)
    before = drive.engine.demands()
    assert demanded(drive) == {"same": ("app", {"fast": 20}), "gone": ("app", {}), "changed": ("old", {})}
    version = drive.engine.demands_version
    reported = change(
        drive,
        speeding(
            actions=[
                a_deploy("same", parameters=fast),
                a_deploy("changed", "new"),
                a_deploy("added", parameters={"text": "at ${speed} m/s"}),
            ]
        ),
    )
    assert reported == []
    assert drive.engine.demands_version != version
    assert demanded(drive) == {
        "same": ("app", {"fast": 20}),
        "changed": ("new", {}),
        "added": ("app", {"text": "at 20 m/s"}),
    }
    after = drive.engine.demands()
    same = [name for name, demand in before.items() if demand.action in ("same", "changed")]
    assert all(name in after for name in same)  # the same demand keeps its name


def test_a_dry_run_publishes_events_without_demands_until_it_is_disabled() -> None:
    drive = Drive(a_detector(), speeding(dryRun=True, actions=[a_deploy("x")]))
    assert drive.take(speed(0.5, 20), until=1) == ["r car started 1"]
    assert drive.engine.demands() == {}
    change(drive, speeding(actions=[a_deploy("x")]))
    assert demanded(drive) == {"x": ("app", {})}
    change(drive, speeding(dryRun=True, actions=[a_deploy("x")]))
    assert drive.engine.demands() == {}


def test_a_disabled_rule_is_not_evaluated_and_has_no_ticks() -> None:
    drive = Drive(a_detector(), speeding(enabled=False, evaluation={"every": "100ms"}))
    assert drive.take(speed(0.5, 20), until=3) == []
    assert drive.engine.next_tick() == at(4)
    change(drive, speeding(evaluation={"every": "100ms"}))
    assert drive.engine.next_tick() == at(3.1)
    assert drive.take(until=4) == ["r car started 3.1"]


def test_parameters_that_cannot_be_rendered_at_the_start_are_rendered_as_soon_as_they_can() -> None:
    signals = [SPEED, {"name": "x", "stream": "pose", "value": "msg.x"}]
    actions = [a_deploy("late", parameters={"x": "${x}", "v": "${speed}"}), a_deploy("soon")]
    drive = Drive(a_detector(), speeding(signals=signals, actions=actions))
    assert drive.take(speed(0.5, 20), until=1) == ["r car started 1"]
    assert demanded(drive) == {"soon": ("app", {})}
    assert "action late" in drive.engine.counters.rules["r"].last_error
    version = drive.engine.demands_version
    drive.take(speed(1.2, 30), until=2)
    assert drive.engine.demands_version == version
    drive.take(place(2.5, "car", 7), until=3)
    assert demanded(drive)["late"] == ("app", {"x": 7, "v": 30})
    assert drive.engine.demands_version != version
    drive.take(place(3.5, "car", 8), until=4)
    assert demanded(drive)["late"] == ("app", {"x": 7, "v": 30})  # rendered once


def test_a_demand_lasts_from_the_start_of_its_episode_to_its_end() -> None:
    drive = Drive(
        a_detector(),
        near(actions=[a_deploy("x", priority=3, operation="Suspend", parameters={"v": "${[a.client, b.client]}"})]),
    )
    drive.take(place(0.5, "a", 0), place(0.5, "b", 100), until=1)
    (demand,) = drive.engine.demands().values()
    event = drive.events[0]
    assert (demand.episode.rule, demand.action, demand.template, demand.priority) == ("near", "x", "app", 3)
    assert demand.operation == "Suspend"
    assert (demand.holder, demand.episode.subject, demand.episode.clients) == ("h", "a+b", ("a", "b"))
    assert (demand.episode.id, demand.episode.onset_time, demand.episode.start_time) == (event.episode.id, at(1), at(1))
    assert demand.parameters == {"v": ["a", "b"]}
    assert demand.episode.values["distance"] == 100
    drive.take(place(1.5, "b", 175), until=2)
    assert list(drive.engine.demands().values()) == [demand]
    drive.take(place(2.5, "b", 250), until=3)
    assert drive.engine.demands() == {}
