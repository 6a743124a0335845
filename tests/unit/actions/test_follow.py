"""With `follow`, demands have the current parameters; an unknown or failing one keeps its last value."""

from __future__ import annotations

from typing import Any

from detector.replay.replaying import replay_arrivals
from tests.driving import Drive, a_deploy, a_detector, a_rule, a_stream, arrival, at, compiled

SIGNALS = [
    {"name": "speed", "stream": "speed", "value": "msg.v"},
    {"name": "x", "stream": "pose", "value": "msg.x"},
]


def following(**parameters: Any) -> Any:
    return a_rule(signals=SIGNALS, when="speed > 10", actions=[a_deploy("d", follow=True, parameters=parameters)])


def speed(seconds: float, value: Any) -> Any:
    return arrival(seconds, "car", {"v": value})


def place(seconds: float, x: Any) -> Any:
    return arrival(seconds, "car", {"x": x}, "pose")


def parameters(drive: Drive) -> list[Any]:
    return [demand.parameters for demand in drive.engine.demands().values()]


def test_with_follow_parameters_change_and_the_demand_keeps_its_name() -> None:
    drive = Drive(a_detector(), following(v="${speed}", fixed=3))
    drive.take(speed(0.5, 20), until=1)
    before, version = drive.engine.demands(), drive.engine.demands_version
    drive.take(speed(1.5, 20), until=2)
    assert drive.engine.demands() == before
    assert drive.engine.demands_version == version
    drive.take(speed(2.5, 25), until=3)
    assert parameters(drive) == [{"v": 25, "fixed": 3}]
    assert drive.engine.demands().keys() == before.keys()
    assert drive.engine.demands_version != version


def test_without_follow_parameters_stay_unchanged() -> None:
    rule = a_rule(signals=SIGNALS, when="speed > 10", actions=[a_deploy("d", parameters={"v": "${speed}"})])
    drive = Drive(a_detector(), rule)
    drive.take(speed(0.5, 20), speed(1.5, 25), until=2)
    assert parameters(drive) == [{"v": 20}]


def test_a_parameter_that_is_unknown_or_fails_keeps_its_last_value_while_the_others_follow() -> None:
    detector = a_detector(a_stream("speed"), a_stream("pose", staleAfter="2s"))
    drive = Drive(detector, following(v="${speed}", x="${x}", text="at ${x}", f="${speed > 24.0 ? x.y : 1.0}"))
    drive.take(place(0.4, 7), speed(0.5, 20), until=1)
    assert parameters(drive) == [{"v": 20, "x": 7, "text": "at 7", "f": 1}]
    drive.take(place(1.4, 8), speed(1.5, 25), until=2)
    assert parameters(drive) == [{"v": 25, "x": 8, "text": "at 8", "f": 1}]
    counters = drive.engine.counters.rules["r"]
    assert counters.unfollowed == 1
    drive.take(speed(4.5, 30), until=5)
    assert parameters(drive) == [{"v": 30, "x": 8, "text": "at 8", "f": 1}]
    assert "action d of car: " in counters.last_unfollowed
    # f fails at 2, 3, 4 and 5; x is stale from 4 on, and with it the text.
    assert counters.unfollowed == 4 + 2 * 2


def test_a_null_parameter_is_omitted_until_it_has_a_value_again() -> None:
    drive = Drive(a_detector(), following(v="${speed > 20.0 ? null : speed}", w=1))
    drive.take(speed(0.5, 20), until=1)
    drive.take(speed(1.5, 25), until=2)
    assert parameters(drive) == [{"w": 1}]
    drive.take(speed(2.5, 15), until=3)
    assert parameters(drive) == [{"v": 15, "w": 1}]


def test_restored_demands_follow_again_from_the_next_evaluation() -> None:
    rule = following(v="${speed}")
    drive = Drive(a_detector(), rule)
    drive.take(speed(0.5, 20), until=1)
    again = Drive(a_detector(), rule)
    again.engine.restore(list(drive.engine.demands().values()), at(0))
    assert parameters(again) == [{"v": 20}]
    again.take(speed(0.5, 30), until=1)
    assert parameters(again) == [{"v": 30}]


def test_an_action_begins_to_follow_when_its_rule_changes() -> None:
    rule = a_rule(signals=SIGNALS, when="speed > 10", actions=[a_deploy("d", parameters={"v": "${speed}"})])
    drive = Drive(a_detector(), rule)
    drive.take(speed(0.5, 20), speed(1.5, 30), until=2)
    assert drive.note(drive.engine.set_rules(compiled(drive.detector, following(v="${speed}")))) == []
    drive.take(speed(2.5, 35), until=3)
    assert parameters(drive) == [{"v": 35}]


def test_the_tasks_of_a_replay_have_their_last_parameters() -> None:
    arrivals = [speed(0.5, 20), speed(1.5, 30), speed(2.5, 40), speed(3.5, 5), speed(4.5, 5)]
    outcome = replay_arrivals([arrivals], a_detector(), [following(v="${speed}")])
    (task,) = outcome.tasks.values()
    assert task.spec.parameters == {"v": 40}
    assert task.spec.end_time is not None
