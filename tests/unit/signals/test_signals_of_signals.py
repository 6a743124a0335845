"""Signals over other signals: windows over the values at earlier evaluations, and statistics of the episode."""

from __future__ import annotations

import itertools
import json
from typing import Any

import pytest
from pydantic import ValidationError

from detector.engine.episodes.record import from_document
from detector.replay.replaying import replay_intake
from tests.driving import POSITION, START, Drive, a_deploy, a_detector, a_rule, at, lines, place, speed
from tests.patience import PATIENCE
from tests.unit.engine.live import Live

SPEED = {"name": "v", "stream": "speed", "value": "msg.v"}
LOW = {"name": "low", "of": "v", "over": "Episode", "aggregate": "Min"}
STATISTICS = [
    LOW,
    {"name": "lowAt", "of": "v", "over": "Episode", "aggregate": "MinTime"},
    {"name": "mean", "of": "v", "over": "Episode", "aggregate": "Mean"},
    {"name": "lasted", "over": "Episode", "aggregate": "Age"},
]


def slow(**spec: Any) -> Any:
    return a_rule(**{"signals": [SPEED, *STATISTICS], "when": "v < 5", "until": "v > 9", **spec})


def test_a_sequence_with_an_absence_is_three_windows_of_one_rule() -> None:
    rule = a_rule(
        signals=[
            SPEED,
            {"name": "braked", "of": "v < 2", "over": "4s", "lag": "4s", "aggregate": "Any"},
            {"name": "rolled", "of": "v > 2 && v < 5", "over": "2s", "lag": "2s", "aggregate": "Any"},
            {"name": "drove", "of": "v >= 5", "over": "2s", "aggregate": "Any"},
        ],
        when="braked && rolled && !drove",
    )
    brakes_rolls_stays = [*map(speed, range(1, 9), [9, 1, 9, 9, 3, 3, 4, 4])]
    drives_on = [*map(speed, range(1, 11), [9, 1, 9, 9, 3, 3, 9, 9, 9, 9])]
    assert Drive(a_detector(), rule).take(*brakes_rolls_stays, until=8) == ["r car started 7"]
    assert Drive(a_detector(), rule).take(*drives_on, until=10) == []
    live = Drive(a_detector(), rule)
    seen = [live.take(sample, until=second) for second, sample in enumerate(brakes_rolls_stays, start=1)]
    assert [*itertools.chain(*seen)] == ["r car started 7"]


def test_the_least_time_to_collision_of_an_episode_is_in_its_end_and_in_the_parameters_that_follow() -> None:
    rule = a_rule(
        scope={"pairs": {"position": POSITION, "within": 100}},
        signals=[
            {"name": "ttc", "of": "timeToCollision(distance, closingSpeed)"},
            {"name": "least", "of": "ttc", "over": "Episode", "aggregate": "Min"},
        ],
        when="ttc < 5",
        until="ttc > 8",
        actions=[a_deploy("x", parameters={"least": "${least}"}, follow=True)],
    )
    drive = Drive(a_detector(), rule)
    parameters = []
    for second, x in enumerate([90.0, 80, 70, 50, 40, 38, 37, 36.9], start=1):
        drive.take(place(second, "a", 0), place(second, "b", x), until=second)
        parameters += [demand.parameters["least"] for demand in drive.engine.demands().values()]
    times = [50 / 20, 40 / 10, 38 / 2]  # the gap and what it shrank by in the last second
    start, end = drive.events
    assert (start.values["ttc"], end.values["ttc"], end.values["least"]) == (times[0], times[2], times[0])
    assert parameters == [times[0], times[0]]


def test_an_end_without_an_evaluation_has_only_the_statistics() -> None:
    drive = Drive(a_detector(clientTimeout="3s"), slow())
    drive.take(speed(1, 4), speed(2, 2), speed(3, 6), until=9)
    assert drive.events[-1].reason == "ClientLost"
    assert drive.events[-1].values == {"low": 2.0, "lowAt": at(2) / 1e9, "mean": 5.0, "lasted": 6.0}


def test_texts_that_read_statistics_are_rendered_again_at_the_end() -> None:
    notify = {"name": "n", "notify": {"zenoh": {"key": "k"}, "title": "slow", "text": "down to ${low} from ${v}"}}
    drive = Drive(a_detector(), slow(actions=[notify]))
    drive.take(speed(1, 4), speed(2, 2), speed(3, 10), until=3)
    assert [event.rendered["n"].values["text"] for event in drive.events] == ["down to 4 from 4", "down to 2 from 10"]


@pytest.mark.parametrize("with_task", [False, True])
def test_statistics_survive_a_restart_by_the_state_volume(with_task: bool) -> None:
    rule = slow(actions=[a_deploy("x")] if with_task else [])
    whole, before = Drive(a_detector(), rule), Drive(a_detector(), rule)
    drive = [speed(1, 4), speed(2, 2), speed(3, 2.1), speed(4, 6), speed(5, 10)]
    whole.take(*drive, until=5)
    before.take(*drive[:3], until=3)
    kept = [from_document(json.loads(json.dumps(each.to_document()))) for each in before.engine.open_episodes()]
    demands = [*before.engine.demands().values()]
    assert len(demands) == with_task
    after = Drive(a_detector(), rule, start=3)
    after.note(after.engine.restore(demands, at(3), kept))
    after.take(*drive[3:], until=5)
    assert lines(after.events) == lines(whole.events[1:])
    assert after.events[-1].values["mean"] == (4 + 2 + 2.1 + 6 + 10) / 5


def test_lost_clients_and_gaps_leave_no_earlier_values() -> None:
    rule = a_rule(signals=[SPEED, {"name": "was", "of": "v", "over": "9s", "aggregate": "Max"}], when="was > 5")
    lost = Drive(a_detector(clientTimeout="2s"), rule)
    assert lost.take(speed(1, 9), speed(5, 1), speed(6, 1), until=7) == ["r car started 1", "r car ClientLost 4"]
    skipped = Drive(a_detector(), rule)
    skipped.take(speed(1, 9), until=2)
    skipped.note(skipped.engine.gap(at(4)))
    assert skipped.take(speed(4.5, 1), until=5) == ["r car Until 5"]


def test_the_replay_of_lags_and_statistics_gives_the_same_events() -> None:
    lagged = {"name": "was", "of": "v", "over": "2s", "lag": "1500ms", "aggregate": "Mean"}
    spec = {"evaluation": {"every": "250ms"}, "signals": [SPEED, lagged, *STATISTICS], "when": "was > 5 && v < 4"}
    with_samples = a_rule("s", **{**spec, "evaluation": {"onSample": "speed"}})
    live = Live(a_detector(), [a_rule(**spec), with_samples])
    for n, value in zip(range(120), itertools.cycle([9, 9, 8, 3, 3, 3, 3, 7]), strict=False):
        live.now = START + n * 400_000_000
        live.put([(f"vehicles/{client}/speed", b'{"v": %d}' % value) for client in ("a", "b")])
        live.evaluator.call(lambda: None).result(PATIENCE)
    recording = live.stop()
    assert {(event.episode.rule, event.started) for event in recording.logged} == set(
        itertools.product("rs", (True, False))
    )
    assert lines(replay_intake(recording.records, None, None).events) == lines(recording.logged)


@pytest.mark.parametrize(
    ("signal", "message"),
    [
        ({"of": "v", "stream": "speed"}, "exactly one of stream, ruleName, model, plugin and of"),
        ({"over": "Episode", "aggregate": "Min"}, "exactly one of"),
        ({"of": "v", "value": "msg.v"}, "a signal with of cannot have value"),
        ({"of": "v", "aggregate": "Age"}, "the aggregates Age and Active"),
        ({"of": "v", "aggregate": "Max"}, "needs a window"),
        ({"stream": "speed", "value": "msg.v", "lag": "1s"}, "lag needs a signal with of"),
        ({"of": "v", "over": "Episode", "lag": "1s", "aggregate": "Max"}, "not valid with over: Episode"),
        ({"of": "v", "over": "Episode", "aggregate": "StdDev"}, "over: Episode needs one of the aggregates"),
        ({"stream": "speed", "value": "msg.v", "over": "Episode", "aggregate": "Max"}, "over: Episode needs"),
        ({"of": "v", "over": "Episodes", "aggregate": "Max"}, "must be a duration above zero.*or Episode"),
        ({"of": "v", "over": "1s", "aggregate": "Quantile"}, "Quantile needs quantile"),
    ],
)  # fmt: skip
def test_invalid_signals_over_signals_are_rejected(signal: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        a_rule(signals=[SPEED, {"name": "s", **signal}], when="true")
