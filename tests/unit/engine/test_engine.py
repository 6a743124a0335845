"""The engine: subjects and their order, episodes from start to end, changed rules, restored episodes."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from detector.assembly import inlets, make_engine
from detector.engine.episodes.demands import Demand
from tests.driving import (
    POSITION,
    SPEED,
    Drive,
    a_deploy,
    a_detector,
    a_rule,
    a_stream,
    arrival,
    at,
    compiled,
    place,
    speed,
)


def speeding(name: str = "r", **spec: Any) -> Any:
    return a_rule(name, **{"signals": [SPEED], "when": "speed > 10", **spec})


def test_an_episode_tells_when_its_condition_began_to_hold_and_when_it_started_and_ended() -> None:
    drive = Drive(a_detector(), speeding(**{"for": "2s"}, cooldown="3s", description="fast"))
    told = drive.take(*(speed(n + 0.5, 20 if n in (1, 2, 3, 5, 6, 7, 8, 9) else 5) for n in range(12)), until=12)
    assert told == ["r car started 4", "r car Until 5", "r car started 10", "r car Until 11"]
    first, last, second, _ = drive.events
    assert (first.onset_time, first.start_time, first.end_time) == (at(2), at(4), None)
    assert (last.onset_time, last.start_time, last.end_time) == (at(2), at(4), at(5))
    assert first.episode == last.episode != second.episode
    assert second.onset_time == at(8)  # the cooldown lasts to 8
    assert first.values == {"speed": 20}
    assert last.values == {"speed": 5}


def test_two_detectors_that_see_the_same_have_episodes_of_their_own() -> None:
    episodes = set()
    for holder in ("north", "south"):
        engine = make_engine(a_detector(), inlets(a_detector()), holder=holder, start=at(0))
        engine.set_rules(compiled(a_detector(), speeding()))
        (event,) = engine.advance([speed(0.5, 20)], at(1))
        episodes.add(event.episode)
    assert len(episodes) == 2


def test_a_condition_may_use_the_clients_name_labels_and_streams() -> None:
    detector = a_detector(clients=[{"name": "rsu", "labels": {"role": "roadside"}}])
    rule = a_rule(
        scope={"client": {"where": 'has(labels.role) && "speed" in streams'}}, when="client == 'rsu'", until="false"
    )
    drive = Drive(detector, rule)
    assert drive.take(speed(0.5, 0, "car"), place(0.5, "rsu", 0), until=1) == []  # no sample on speed
    assert drive.take(speed(1.5, 0, "rsu"), until=2) == ["r rsu started 2"]
    told = drive.take(*(place(2 + n, "rsu", 0) for n in range(35)), until=36)
    assert told == ["r rsu OutOfScope 7"]  # speed is stale, the client is not lost


def near(name: str = "near", **spec: Any) -> Any:
    return a_rule(
        name,
        **{
            "scope": {"pairs": {"position": POSITION, "within": 250}},
            "when": "distance < 150",
            "until": "distance > 200",
            **spec,
        },
    )


def test_a_pair_is_looked_at_once_with_the_smaller_name_first() -> None:
    drive = Drive(a_detector(), near(when="a.position.x > b.position.x"))
    assert drive.take(place(0.5, "car2", 0), place(0.6, "car10", 100), place(0.7, "b", -9), until=1) == [
        "near car10+car2 started 1"
    ]
    (event,) = drive.events
    assert event.subjects == ("car10", "car2")
    assert event.values["distance"] == 100
    assert event.values["a"] == {"client": "car10", "position": {"x": 100, "y": 0, "z": 0}}


def test_reach_gates_the_start_and_not_the_end() -> None:
    rule = near(scope={"pairs": {"position": POSITION, "within": 50}})
    drive = Drive(a_detector(), rule)
    assert drive.take(place(0.5, "a", 0), place(0.5, "b", 60), until=1) == []
    assert drive.take(place(1.5, "b", 50), until=2) == ["near a+b started 2"]
    assert drive.take(place(2.5, "b", 190), until=3) == []
    assert drive.take(place(3.5, "b", 201), until=4) == ["near a+b Until 4"]


def test_where_turning_false_ends_a_pairs_episode_as_out_of_scope() -> None:
    rule = near(
        scope={"pairs": {"position": POSITION, "within": 250, "where": '"speed" in a.streams && "speed" in b.streams'}}
    )
    detector = a_detector(a_stream("pose"), a_stream("speed", staleAfter="3s"))
    drive = Drive(detector, rule)
    both = [each for n in range(8) for each in (place(n + 0.5, "a", 0), place(n + 0.5, "b", 100))]
    heard = [*both, speed(0.2, 1, "a"), speed(1.2, 1, "b")]
    assert drive.take(*sorted(heard), until=8) == ["near a+b started 2", "near a+b OutOfScope 4"]


def test_a_position_that_is_unknown_for_no_longer_than_for_does_not_begin_the_onset_anew() -> None:
    detector = a_detector(a_stream("pose", staleAfter="1s"))
    drive = Drive(detector, near(**{"for": "3s"}))
    told = drive.take(
        *sorted(each for t in (0.5, 4.5) for each in (place(t, "a", 0), place(t, "b", 100))),
        until=5,
    )
    assert told == ["near a+b started 5"]
    assert drive.events[0].onset_time == at(1)


def test_a_pair_in_three_dimensions() -> None:
    position = {**POSITION, "z": "msg.z"}
    rule = near(scope={"pairs": {"position": position, "within": 5}}, when="distance == 3.0")
    drive = Drive(a_detector(), rule)
    told = drive.take(
        arrival(0.5, "a", {"x": 1, "y": 2, "z": 2}, "pose"),
        arrival(0.5, "b", {"x": 0, "y": 0, "z": 0}, "pose"),
        until=1,
    )
    assert told == ["near a+b started 1"]


def test_events_of_a_tick_come_by_rule_and_then_by_subject_whatever_the_order_of_arrival() -> None:
    rules = [speeding("b"), speeding("a", until="speed < 5"), near("ab")]
    drive = Drive(a_detector(), *rules)
    told = drive.take(
        *(speed(0.1 + n / 100, 20, client) for n, client in enumerate(("z", "a", "m"))),
        *(place(0.5 + n / 100, client, 0) for n, client in enumerate(("z", "m", "a"))),
        until=1,
    )
    assert told == [
        *("a a started 1", "a m started 1", "a z started 1"),
        *("ab a+m started 1", "ab a+z started 1", "ab m+z started 1"),
        *("b a started 1", "b m started 1", "b z started 1"),
    ]


def test_lost_starting_and_ending_subjects_of_one_tick_come_in_order() -> None:
    drive = Drive(a_detector(clientTimeout="3s"), speeding())
    drive.take(*(speed(0.5, 20, client) for client in ("b", "d")), until=1)
    told = drive.take(speed(3.9, 1, "d"), speed(3.9, 20, "c"), speed(3.9, 20, "a"), until=4)
    assert told == ["r a started 4", "r b ClientLost 4", "r c started 4", "r d Until 4"]


def test_a_client_gone_longer_than_the_timeout_ends_its_episodes_and_pairs() -> None:
    detector = a_detector(clientTimeout="5s")
    drive = Drive(detector, speeding(), near(), speeding("calm", when="speed > 90"))
    told = drive.take(*sorted([speed(1, 20, "a"), place(1, "a", 0), place(1, "b", 9)]), until=1)
    assert told == ["near a+b started 1", "r a started 1"]
    assert drive.take(*(place(2 + n, "b", 9) for n in range(5)), until=6) == []  # exactly the timeout is not longer
    assert drive.take(place(6.5, "b", 9), until=7) == ["near a+b ClientLost 7", "r a ClientLost 7"]
    assert list(drive.engine.clients) == ["b"]


def test_a_lost_client_that_was_pending_is_forgotten() -> None:
    drive = Drive(a_detector(a_stream("speed", staleAfter="Never"), clientTimeout="3s"), speeding(**{"for": "4s"}))
    assert drive.take(speed(0.5, 20), until=4) == []
    assert drive.take(speed(4.5, 20), speed(7, 20), until=8) == []  # it would have started at 5
    assert drive.take(until=9) == ["r car started 9"]


def test_a_latched_sample_of_a_lost_client_is_there_when_it_returns() -> None:
    detector = a_detector(a_stream("pose"), a_stream("speed", staleAfter="Never"), clientTimeout="3s")
    drive = Drive(detector, speeding())
    assert drive.take(speed(0.5, 20), until=9) == ["r car started 1", "r car ClientLost 4"]
    assert drive.take(place(9.5, "car", 0), until=10) == ["r car started 10"]


def test_an_episode_whose_condition_stays_unknown_ends_as_unknown() -> None:
    detector = a_detector(a_stream("pose"), a_stream("speed", staleAfter="2s"))
    told = {}
    for timeout in ({"unknownTimeout": "4s"}, {}):
        drive = Drive(detector, speeding(**timeout))
        alive = [place(n + 0.1, "car", 0) for n in range(50)]
        told[len(timeout)] = drive.take(*sorted([speed(0.5, 20), *alive]), until=50)
    assert told[1] == ["r car started 1", "r car Unknown 7"]  # stale from 3 on
    assert told[0] == ["r car started 1", "r car Unknown 33"]  # by default, the Detector's clientTimeout


# Changed rules


def demanded(drive: Drive) -> dict[str, Any]:
    """What is demanded, by action."""
    return {demand.action: (demand.template, demand.parameters) for demand in drive.engine.demands().values()}


def change(drive: Drive, *rules: Any) -> list[str]:
    return drive.note(drive.engine.set_rules(compiled(drive.detector, *rules)))


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
def test_a_rule_that_means_something_else_ends_its_episodes(spec: dict[str, Any]) -> None:
    drive = Drive(a_detector(), speeding(actions=[a_deploy("x")]), speeding("other"))
    drive.take(speed(0.5, 20), until=1.5)
    version = drive.engine.demands_version
    assert change(drive, speeding(actions=[a_deploy("x")], **spec), speeding("other")) == ["r car RuleChanged 1.5"]
    assert drive.engine.demands() == {}
    assert drive.engine.demands_version != version


def test_a_rule_that_is_gone_ends_its_episodes() -> None:
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


def test_changed_actions_are_applied_to_open_episodes_with_what_was_seen_at_their_start() -> None:
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
    told = change(
        drive,
        speeding(
            actions=[
                a_deploy("same", parameters=fast),
                a_deploy("changed", "new"),
                a_deploy("added", parameters={"text": "at ${speed} m/s"}),
            ]
        ),
    )
    assert told == []
    assert drive.engine.demands_version != version
    assert demanded(drive) == {
        "same": ("app", {"fast": 20}),
        "changed": ("new", {}),
        "added": ("app", {"text": "at 20 m/s"}),
    }
    after = drive.engine.demands()
    same = [name for name, demand in before.items() if demand.action in ("same", "changed")]
    assert all(name in after for name in same)  # the same demand keeps its name


def test_a_dry_run_tells_events_and_demands_nothing_until_it_is_over() -> None:
    drive = Drive(a_detector(), speeding(dryRun=True, actions=[a_deploy("x")]))
    assert drive.take(speed(0.5, 20), until=1) == ["r car started 1"]
    assert drive.engine.demands() == {}
    change(drive, speeding(actions=[a_deploy("x")]))
    assert demanded(drive) == {"x": ("app", {})}
    change(drive, speeding(dryRun=True, actions=[a_deploy("x")]))
    assert drive.engine.demands() == {}


def test_a_disabled_rule_is_not_evaluated_and_its_ticks_do_not_come() -> None:
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


def test_a_demand_is_held_from_the_start_of_its_episode_to_its_end() -> None:
    drive = Drive(
        a_detector(),
        near(actions=[a_deploy("x", priority=3, operation="Suspend", parameters={"v": "${[a.client, b.client]}"})]),
    )
    drive.take(place(0.5, "a", 0), place(0.5, "b", 100), until=1)
    (demand,) = drive.engine.demands().values()
    event = drive.events[0]
    assert (demand.rule, demand.action, demand.template, demand.priority) == ("near", "x", "app", 3)
    assert demand.operation == "Suspend"
    assert (demand.holder, demand.subject, demand.subjects) == ("h", "a+b", ("a", "b"))
    assert (demand.episode, demand.onset_time, demand.start_time) == (event.episode, at(1), at(1))
    assert demand.parameters == {"v": ["a", "b"]}
    assert demand.values["distance"] == 100
    drive.take(place(1.5, "b", 175), until=2)
    assert list(drive.engine.demands().values()) == [demand]
    drive.take(place(2.5, "b", 250), until=3)
    assert drive.engine.demands() == {}


# Restored episodes


def held_by(rule: Any, client: str = "car", **fields: Any) -> Demand:
    """A demand that was held before a restart: an episode of the rule that started long ago."""
    drive = Drive(a_detector(), rule, start=-1_000)
    drive.take(speed(-999.5, 20, client), place(-999.5, client, 0), place(-999.4, "zz", 0), until=-999)
    demand = next(demand for demand in drive.engine.demands().values() if client in demand.subjects)
    return dataclasses.replace(demand, **fields)


RECORD = speeding(actions=[a_deploy("x", parameters={"v": "${speed}"})])


def test_a_restored_episode_holds_its_demand_as_it_was_and_keeps_its_times() -> None:
    demand = held_by(RECORD)
    drive = Drive(a_detector(), RECORD)
    assert drive.note(drive.engine.restore([demand], at(0))) == []
    assert list(drive.engine.demands().values()) == [demand]
    drive.take(speed(0.5, 11), until=5)
    assert list(drive.engine.demands().values()) == [demand]
    assert drive.take(speed(5.5, 9), until=6) == ["r car Until 6"]
    (event,) = drive.events
    assert (event.episode, event.onset_time, event.start_time) == (demand.episode, at(-999), at(-999))


def test_a_restored_episode_does_not_start_again() -> None:
    drive = Drive(a_detector(), RECORD)
    drive.engine.restore([held_by(RECORD)], at(0))
    assert drive.take(*(speed(n + 0.5, 20) for n in range(5)), until=5) == []


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


def test_a_restored_client_that_is_not_heard_is_lost_after_the_timeout_from_the_start() -> None:
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
    assert drive.events[0].episode == demand.episode
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
    assert {demand.start_time for demand in drive.engine.demands().values()} == {at(-999)}


def test_actions_that_change_after_a_restart_let_no_demand_go_before_it_is_rendered_anew() -> None:
    drive = Drive(a_detector(), RECORD)
    drive.engine.restore([held_by(RECORD)], at(0))
    drive.take(speed(0.5, 15), until=1)
    assert change(drive, speeding(actions=[a_deploy("x", parameters={"v": "${speed}", "w": 1})])) == []
    assert demanded(drive) == {"x": ("app", {"v": 20})}
    drive.take(speed(1.5, 16), until=2)
    assert demanded(drive) == {"x": ("app", {"v": 16, "w": 1})}


@pytest.mark.parametrize("subjects", [(), ("a", "b"), ("a", "a", "b")])
def test_a_task_whose_subjects_are_none_of_its_rule_is_no_open_episode(subjects: tuple[str, ...]) -> None:
    drive = Drive(a_detector(), RECORD)
    demand = held_by(RECORD, subjects=subjects)
    assert [event.reason for event in drive.engine.restore([demand], at(0))] == ["RuleChanged"]
    assert drive.take(speed(0.5, 20), until=1) == ["r car started 1"]


def test_restored_episodes_of_pairs_need_two_clients_in_order() -> None:
    rule = near(actions=[a_deploy("x")])
    for subjects in (("zz", "car"), ("car", "car"), ("car",)):
        drive = Drive(a_detector(), rule)
        demand = held_by(rule, subjects=subjects)
        assert len(drive.engine.restore([demand], at(0))) == 1
        assert drive.take(place(0.5, "car", 0), place(0.5, "zz", 175), until=1) == []


def test_the_two_tasks_of_one_episode_restore_one_episode() -> None:
    rule = speeding(actions=[a_deploy("x"), a_deploy("y")])
    drive = Drive(a_detector(), rule, start=-1_000)
    drive.take(speed(-999.5, 20), until=-999)
    held = drive.engine.demands()
    again = Drive(a_detector(), rule)
    again.engine.restore(list(held.values()), at(0))
    assert again.engine.demands() == held
    assert again.take(speed(0.5, 1), until=1) == ["r car Until 1"]


def test_of_two_episodes_of_one_subject_the_second_is_no_episode() -> None:
    first, second = held_by(RECORD), held_by(RECORD, episode="zzz", start_time=at(-5))
    drive = Drive(a_detector(), RECORD)
    told = drive.engine.restore([second, first], at(0))
    assert [(event.episode, event.reason) for event in told] == [("zzz", "RuleChanged")]
    assert list(drive.engine.demands().values()) == [first]
