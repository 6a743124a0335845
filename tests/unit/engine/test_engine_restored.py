"""The engine: episodes that are restored after a restart of the detector."""

from __future__ import annotations

import dataclasses
from typing import Any

import msgspec
import pytest

from detector.engine.episodes.demands import Demand
from tests.driving import Drive, a_deploy, a_detector, at, place, speed
from tests.unit.engine.rules import change, demanded, near, speeding


def held_by(rule: Any, client: str = "car", **fields: Any) -> Demand:
    """A demand that was held before a restart: an episode of the rule that started long ago."""
    drive = Drive(a_detector(), rule, start=-1_000)
    drive.take(speed(-999.5, 20, client), place(-999.5, client, 0), place(-999.4, "zz", 0), until=-999)
    demand = next(demand for demand in drive.engine.demands().values() if client in demand.episode.clients)
    return dataclasses.replace(demand, episode=msgspec.structs.replace(demand.episode, **fields))


RECORD = speeding(actions=[a_deploy("x", parameters={"v": "${speed}"})])


def test_a_restored_episode_keeps_its_demand_and_times() -> None:
    demand = held_by(RECORD)
    drive = Drive(a_detector(), RECORD)
    assert drive.note(drive.engine.restore([demand], at(0))) == []
    assert list(drive.engine.demands().values()) == [demand]
    drive.take(speed(0.5, 11), until=5)
    assert list(drive.engine.demands().values()) == [demand]
    assert drive.take(speed(5.5, 9), until=6) == ["r car Until 6"]
    (event,) = drive.events
    assert (event.episode.id, event.episode.onset_time, event.episode.start_time) == (
        demand.episode.id,
        at(-999),
        at(-999),
    )


def test_a_restored_episode_does_not_start_again() -> None:
    drive = Drive(a_detector(), RECORD)
    drive.engine.restore([held_by(RECORD)], at(0))
    assert drive.take(*(speed(n + 0.5, 20) for n in range(5)), until=5) == []


def test_clients_of_restored_episodes_may_return_one_by_one() -> None:
    rule = speeding(evaluation={"onSample": "speed"}, actions=[a_deploy("x")])
    drive = Drive(a_detector(), rule)
    drive.engine.restore([held_by(rule, client) for client in ("a", "b", "c")], at(0))
    assert drive.take(speed(0.5, 1, "b"), until=1) == ["r b Until 0.5"]
    assert drive.take(speed(1.5, 1, "c"), speed(1.6, 1, "a"), until=2) == ["r c Until 1.5", "r a Until 1.6"]


def test_only_a_restored_episode_keeps_the_demand_of_a_pair_between_the_thresholds() -> None:
    rule = near(actions=[a_deploy("x")])
    demand = held_by(rule)
    between = [each for n in range(9) for each in (place(n + 0.5, "car", 0), place(n + 0.5, "zz", 175))]
    fresh = Drive(a_detector(), rule)
    assert fresh.take(*between, until=9) == []
    drive = Drive(a_detector(), rule)
    drive.engine.restore([demand], at(0))
    assert drive.take(*between, until=9) == []
    assert [each.name for each in drive.engine.demands().values()] == [demand.name]


def test_a_silent_restored_client_is_lost_one_timeout_after_the_start() -> None:
    drive = Drive(a_detector(clientTimeout="10s"), RECORD)
    drive.engine.restore([held_by(RECORD)], at(0.5))
    assert drive.take(until=10.5) == []
    assert drive.take(until=12) == ["r car ClientLost 11"]


@pytest.mark.parametrize(
    "rules",
    [
        (),
        (speeding("other"),),
        (speeding(when="speed > 12", actions=[a_deploy("x")]),),
        (speeding(enabled=False, actions=[a_deploy("x")]),),
    ],
)
def test_an_episode_whose_rule_changed_while_the_detector_was_away_ends(rules: tuple[Any, ...]) -> None:
    demand = held_by(RECORD)
    drive = Drive(a_detector(), *rules)
    assert drive.note(drive.engine.restore([demand], at(0.5))) == ["r car RuleChanged 0.5"]
    assert drive.events[0].episode.id == demand.episode.id
    assert drive.engine.demands() == {}
    assert "car" not in drive.engine.clients


def test_actions_that_changed_while_the_detector_was_away_are_applied_at_the_next_evaluation() -> None:
    old = speeding(actions=[a_deploy("gone"), a_deploy("same"), a_deploy("moved", "old")])
    drive = Drive(a_detector(), old, start=-1_000)
    drive.take(speed(-999.5, 20), until=-999)
    held = list(drive.engine.demands().values())
    new = speeding(
        actions=[a_deploy("same"), a_deploy("moved", "new"), a_deploy("added", parameters={"v": "${speed}"})]
    )
    drive = Drive(a_detector(), new)
    assert drive.note(drive.engine.restore(held, at(0))) == []
    assert demanded(drive) == {"same": ("app", {}), "moved": ("old", {})}
    drive.take(speed(0.5, 15), until=1)
    assert demanded(drive) == {"same": ("app", {}), "moved": ("new", {}), "added": ("app", {"v": 15})}
    assert {demand.episode.start_time for demand in drive.engine.demands().values()} == {at(-999)}


def test_actions_changed_after_a_restart_keep_demands_until_they_are_rendered_again() -> None:
    drive = Drive(a_detector(), RECORD)
    drive.engine.restore([held_by(RECORD)], at(0))
    drive.take(speed(0.5, 15), until=1)
    assert change(drive, speeding(actions=[a_deploy("x", parameters={"v": "${speed}", "w": 1})])) == []
    assert demanded(drive) == {"x": ("app", {"v": 20})}
    drive.take(speed(1.5, 16), until=2)
    assert demanded(drive) == {"x": ("app", {"v": 16, "w": 1})}


@pytest.mark.parametrize("clients", [(), ("a", "b"), ("a", "a", "b")])
def test_a_task_with_subjects_outside_its_rule_restores_no_episode(clients: tuple[str, ...]) -> None:
    drive = Drive(a_detector(), RECORD)
    demand = held_by(RECORD, clients=clients)
    assert [event.reason for event in drive.engine.restore([demand], at(0))] == ["RuleChanged"]
    assert drive.take(speed(0.5, 20), until=1) == ["r car started 1"]


def test_restored_episodes_of_pairs_need_two_clients_in_order() -> None:
    rule = near(actions=[a_deploy("x")])
    for clients in (("zz", "car"), ("car", "car"), ("car",)):
        drive = Drive(a_detector(), rule)
        demand = held_by(rule, clients=clients)
        assert len(drive.engine.restore([demand], at(0))) == 1
        assert drive.take(place(0.5, "car", 0), place(0.5, "zz", 175), until=1) == []


def test_two_tasks_of_an_episode_restore_one_episode() -> None:
    rule = speeding(actions=[a_deploy("x"), a_deploy("y")])
    drive = Drive(a_detector(), rule, start=-1_000)
    drive.take(speed(-999.5, 20), until=-999)
    held = drive.engine.demands()
    again = Drive(a_detector(), rule)
    again.engine.restore(list(held.values()), at(0))
    assert again.engine.demands() == held
    assert again.take(speed(0.5, 1), until=1) == ["r car Until 1"]


def test_a_second_episode_of_a_subject_is_not_restored() -> None:
    first, second = held_by(RECORD), held_by(RECORD, id="zzz", start_time=at(-5))
    drive = Drive(a_detector(), RECORD)
    reported = drive.engine.restore([second, first], at(0))
    assert [(event.episode.id, event.reason) for event in reported] == [("zzz", "RuleChanged")]
    assert list(drive.engine.demands().values()) == [first]
