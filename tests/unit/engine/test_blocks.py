"""Many ticks evaluated at once see the same as single ticks, and their events keep their order."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest

from detector.engine.buffering import ingest
from detector.engine.columns import tables
from detector.engine.columns.tables import Tables
from detector.replay.replaying import Replay, ReplayResult
from tests.driving import (
    SPEED,
    START,
    a_deploy,
    a_detector,
    a_rule,
    a_stream,
    an_engine,
    arrival,
    at,
    compiled,
    lines,
    place,
    reported,
    speed,
)
from tests.unit.engine.rules import near, speeding
from wayside.api import Detector
from wayside.rules import in_order

SECONDLY, FIFTHS, OFTEN = {"every": "1s"}, {"every": "200ms"}, {"every": "100ms"}


def in_one_go(detector: Detector, rules: Iterable[Any], arrivals: Iterable[Any], until: float) -> list[str]:
    engine = an_engine(detector, *rules)
    return lines(engine.advance([*arrivals], at(until)))


def one_by_one(detector: Detector, rules: Iterable[Any], arrivals: Iterable[Any], until: float) -> list[str]:
    """Each arrival in a call of its own; the last tick too."""
    engine = an_engine(detector, *rules)
    events = [event for each in arrivals for event in engine.advance([each], each.received)]
    return lines(events + engine.advance([], at(until)))


def test_ticks_hours_before_the_next_sample_see_earlier_samples() -> None:
    detector = a_detector(a_stream("speed", staleAfter="Never"), clientTimeout="48h")
    engine = an_engine(detector, speeding(evaluation={"every": "10s"}))
    events = engine.advance([speed(1, 20), speed(12 * 3600, 5)], at(12 * 3600))
    assert reported(events) == ["r car started 10", "r car Until 43200"]


def test_windows_do_not_reach_across_a_gap() -> None:
    fastest = {**SPEED, "over": "10s", "aggregate": "Max"}
    engine = an_engine(
        a_detector(clientTimeout="1m"), a_rule(signals=[fastest], when="speed > 10", evaluation=SECONDLY)
    )
    events = engine.advance([speed(0.5, 20)], at(2)) + engine.gap(at(3))
    assert reported(events + engine.advance([speed(3.5, 5)], at(6))) == ["r car started 1", "r car Until 4"]


def test_a_stream_that_is_exactly_as_old_as_its_limit_is_not_stale() -> None:
    detector = a_detector(a_stream("speed", staleAfter="1s"))
    events = an_engine(detector, speeding(evaluation=SECONDLY, **{"for": "1s"})).advance([speed(1, 20)], at(2))
    assert reported(events) == ["r car started 2"]


def test_a_condition_that_columns_cannot_take_sees_the_sign_of_zero() -> None:
    rule = a_rule(signals=[SPEED], when="[speed].exists(x, 1.0 / x < 0.0)", evaluation=SECONDLY)
    events = an_engine(a_detector(), rule).advance([speed(0.5, 0.0), speed(1.5, -0.0), speed(2.5, 0.0)], at(4))
    assert reported(events) == ["r car started 2", "r car Until 3"]


def test_a_cap_evicts_only_the_samples_beyond_it() -> None:
    """The buffer forgets what is old at whole seconds, while ticks that saw it still wait to be evaluated."""
    detector = a_detector(
        a_stream("speed", staleAfter="Never"), clientTimeout="1m", buffer={"duration": "3s", "bytes": "4k"}
    )
    count = {"name": "n", "stream": "speed", "over": "2s", "aggregate": "Count"}
    rule = a_rule(signals=[count], when="n > 2", evaluation={"every": "500ms"})
    arrivals = [arrival(number / 10, "car", {"v": 1, "pad": "x" * 900}) for number in range(1, 9)]
    engine = an_engine(detector, rule)
    assert reported(engine.advance(arrivals, at(12))) == ["r car started 0.5", "r car Until 3"]
    assert engine.buffer.evicted > 0
    assert in_one_go(detector, [rule], arrivals, 12) == one_by_one(detector, [rule], arrivals, 12)


def test_samples_without_a_value_count_only_while_their_client_is_known() -> None:
    detector = a_detector(a_stream("speed", staleAfter="Never"), clientTimeout="1s", buffer={"duration": "9s"})
    rule = a_rule(signals=[{**SPEED, "over": "5s", "aggregate": "Max"}], when="speed > 10", evaluation=OFTEN)
    without, back = arrival(0.95, "car", {}), arrival(7.95, "car", {"v": 1})
    arrivals = [arrival(n / 10, "van", {"v": 1}) for n in range(1, 79)]
    counts = []
    for together in (True, False):
        engine = an_engine(detector)
        engine.advance(sorted([*arrivals[:29], without]), at(3))  # the car is lost before the rule is there
        engine.set_rules(compiled(detector, rule))
        rest = [*arrivals[30:], back]
        for part in [rest] if together else [[each] for each in rest]:
            engine.advance(part, part[-1].received)
        engine.advance([], at(9))
        counts.append(engine.counters.rules["r"].unknowns)
    assert counts[0] == counts[1]


def fleet_that_comes_and_goes() -> list[Any]:
    """Every client for a second, then others; some come back."""
    return [
        arrival(second + part / 10, f"car{second * 3 % 26 + part}", {"v": 10 * part, "gear": f"g{second}{part}"})
        for second in range(30)
        for part in range(1, 5)
    ]


GEARS = a_rule(
    "gears", signals=[{"name": "gear", "stream": "speed", "value": "msg.gear"}], when="gear != 'g31'", evaluation=OFTEN
)


@pytest.mark.parametrize("limit", ["MAXIMUM_CLIENTS", "_MAXIMUM_TEXTS"])
def test_the_numbering_of_clients_and_texts_restarts_at_its_limit(limit: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ingest, "MAXIMUM_LOST", 3)
    detector = a_detector(clientTimeout="1s")
    rules = [speeding("fast", evaluation=OFTEN, **{"for": "300ms"}), GEARS]
    arrivals = fleet_that_comes_and_goes()
    expected = one_by_one(detector, rules, arrivals, 33)
    assert len(expected) > 100
    monkeypatch.setattr(tables, limit, 20)
    versions: list[Tables] = []
    monkeypatch.setattr(
        Tables, "follow", lambda new, old, follow=Tables.follow: (versions.append(new), follow(new, old))
    )
    for way in (one_by_one, in_one_go):
        assert way(detector, rules, arrivals, 33) == expected
        assert 2 <= len(versions) < 30
        versions.clear()


def test_skipped_evaluations_leave_no_state() -> None:
    engine = an_engine(a_detector(), speeding(evaluation={"every": "100ms", "priority": 1}))
    for second in range(1, 20):
        engine.set_level(second % 3)
        engine.advance([speed(second, second)], at(second + 0.5))
    assert len(engine._inputs.tables.table("speed").marks) == 1  # else they grow with each change


def tasks_of(rule: Any, arrivals: list[Any], cut: int) -> dict[str, Any]:
    """The tasks of a replay that takes this number of arrivals at once."""
    outcome = ReplayResult()
    replay = Replay(a_detector(), [rule], holder="h", start=START, outcome=outcome)
    for begin in range(0, len(arrivals), cut):
        taken = arrivals[begin : begin + cut]
        replay.advance(taken, taken[-1].received)
    return {name: task.model_dump(mode="json")["spec"] for name, task in sorted(outcome.tasks.items())}


def test_a_replay_writes_tasks_that_start_and_end_within_one_call() -> None:
    follow = {"name": "f", "deploy": {"templateName": "app", "follow": True, "parameters": {"v": "${speed}"}}}
    rule = speeding(actions=[a_deploy("a"), follow], evaluation=OFTEN)
    arrivals = [
        speed(second + part / 10 + late, value, client)
        for second in range(1, 9)
        for part, value in enumerate((5, 20, 21.5, 22, 5))
        for client, late in (("car", 0), ("bus", 0.05))
    ][:-1]  # the bus's last episode continues
    whole, single = (tasks_of(rule, arrivals, cut) for cut in (1000, 1))
    assert whole == single
    assert len(whole) == 2 * 16
    assert [task["requester"]["subjects"] for task in whole.values() if task["end_time"] is None] == [["bus"], ["bus"]]
    assert {str(task["parameters"]) for task in whole.values()} == {"{}", "{'v': 22.0}"}


def test_events_of_a_tick_are_in_rule_order_with_and_without_columns() -> None:
    detector = a_detector(
        a_stream("speed"), a_stream("mode", latched=True), a_stream("capped", buffer={"count": 3}), clientTimeout="5s"
    )
    rules = [
        speeding("a", evaluation=FIFTHS),
        a_rule(
            "b", signals=[{"name": "active", "ruleName": "e", "aggregate": "Active"}], when="active", evaluation=FIFTHS
        ),
        a_rule(
            "c",
            signals=[SPEED],
            scope={"fleet": {"members": "speed > 10"}},
            when="size(members) > 1",
            evaluation=FIFTHS,
        ),
        a_rule(
            "d", signals=[{"name": "mode", "stream": "mode", "value": "msg.v"}], when="mode > 10", evaluation=FIFTHS
        ),
        speeding("e", evaluation=FIFTHS),
        a_rule("f", signals=[{"name": "n", "stream": "capped", "value": "msg.v"}], when="n > 10", evaluation=FIFTHS),
        speeding("g", evaluation={"onSample": "speed"}),
        speeding("h", evaluation=FIFTHS),
    ]
    arrivals = [
        arrival(second + 0.2, client, {"v": 20 if second % 2 else 5}, stream)
        for second in range(1, 7)
        for stream in ("speed", "mode", "capped")
        for client in ("x", "y")
    ]
    engine = an_engine(detector, *rules)
    order = [rule.name for rule in in_order([run.rule for run in engine.rules.values()])]
    events = engine.advance(arrivals, at(8))
    keys = [(event.time, order.index(event.episode.rule), event.episode.subject) for event in events]
    assert keys == sorted(keys)
    assert {event.episode.rule for event in events if event.episode.start_time == at(1.2)} == set("abcdefgh")
    whole, seconds = lines(events), an_engine(detector, *rules)
    cut = [arrivals[begin : begin + 6] for begin in range(0, len(arrivals), 6)]
    assert whole == lines(
        [e for part in cut for e in seconds.advance(part, part[-1].received)] + seconds.advance([], at(8))
    )


def test_columns_of_removed_rules_are_no_longer_read() -> None:
    engine = an_engine(a_detector(), speeding())
    for number in range(100):
        changed = a_rule(signals=[{**SPEED, "value": f"msg.v + {number}.5"}], when="speed > 10")
        engine.set_rules(compiled(a_detector(), changed))
    assert engine.advance([speed(0.5, 20)], at(1))
    assert engine._inputs.tables.readers["speed"].count < 20


def test_the_age_of_a_stream_is_that_of_its_last_sample_even_if_evicted() -> None:
    """A tick that waits while the next sample comes does not see it, and still knows of the one that is gone."""
    detector = a_detector(
        a_stream("speed", staleAfter="Never"),
        a_stream("other"),
        clientTimeout="1m",
        buffer={"duration": "1s", "bytes": "4k"},
    )
    rule = a_rule(
        signals=[{"name": "age", "stream": "speed", "aggregate": "Age"}], when="age > 3.5", evaluation=SECONDLY
    )
    filling = [arrival(1.5 + n / 100, "car", {}, stream="other") for n in range(100)]
    arrivals = [arrival(0.1, "car", {}, stream="other"), speed(1, 20), *filling, speed(4.2, 20)]
    assert one_by_one(detector, [rule], arrivals, 6) == in_one_go(detector, [rule], arrivals, 6) == []


def test_pairs_are_evaluated_before_the_first_client_if_not_all_have_the_stream() -> None:
    lights = {**a_stream("speed"), "key": "lights/speed", "client": "light"}
    rule = near(signals=[SPEED], when="distance < 150 && a.speed > 10", evaluation=SECONDLY)
    engine = an_engine(a_detector(a_stream("pose"), lights), rule)
    assert engine.advance([], at(2)) == []
    assert engine.advance([place(2.5, "car", 0), place(2.5, "zz", 10)], at(4)) == []


def test_pairs_continue_when_other_rules_change() -> None:
    rule = near(signals=[SPEED], when="distance < 150 && a.speed > 10", evaluation=SECONDLY)
    detector = a_detector()
    engine = an_engine(detector, rule)
    engine.advance([place(0.5, "car", 0), place(0.5, "zz", 10), speed(0.5, 5)], at(1))
    for number in range(3):
        other = near(f"other{number}", evaluation=SECONDLY)
        engine.set_rules(compiled(detector, rule, other))
        engine.advance([speed(number + 1.5, 5)], at(number + 2))
    assert reported(engine.advance([speed(4.5, 20)], at(5))) == ["near car+zz started 5"]
