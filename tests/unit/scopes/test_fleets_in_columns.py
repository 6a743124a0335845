"""Rules about the fleet in columns: loops over members follow Kleene's logic, as CEL's do."""

from __future__ import annotations

import pytest

from tests.driving import SPEED, a_detector, a_rule, an_engine, arrival, at, reported

ARRIVALS = [arrival(0.1, "a", {"v": 20}), arrival(0.2, "b", {}), arrival(0.3, "c", {"v": 1})]


@pytest.mark.parametrize(
    ("condition", "expected"),
    [
        ("members.exists(m, m.speed > 10)", True),
        ("members.exists(m, m.speed > 30)", None),
        ("members.all(m, m.speed > 0)", None),
        ("members.all(m, m.speed > 10)", False),
        ("members.exists_one(m, m.speed > 10)", None),
        ("size(members.filter(m, m.speed > 10)) >= 0", None),
        ("members.exists(m, m.client == 'b')", True),
        ("size(members) == 3", True),
        ("members.all(m, m.speed > 0 || m.client == 'b')", True),
        ("size(members.filter(m, has(m.speed))) == parameters.known", True),
        ("members.exists(m, m.name < 'd')", None),
        ("members.map(m, m.client)[2] == 'c'", True),
        ("false && members.exists(m, m.speed > 30)", False),
    ],
)
def test_loops_over_members_with_an_unknown_value(condition: str, expected: bool | None) -> None:
    name = {"name": "name", "stream": "speed", "value": "msg.name"}
    fleet = {"scope": {"fleet": {"members": "true"}}, "signals": [SPEED, name], "parameters": {"known": 2.0}}
    rules = [
        a_rule("it", when=condition, evaluation={"every": "1s"}, **fleet),
        a_rule("not", when=f"!({condition})", evaluation={"every": "1s"}, **fleet),
    ]
    events = an_engine(a_detector(), *rules).advance(ARRIVALS, at(1))
    happened = {True: ["it ~fleet started 1"], False: ["not ~fleet started 1"], None: []}
    assert reported(events) == happened[expected]


def test_only_certain_members_count() -> None:
    rule = a_rule(
        scope={"fleet": {"members": "speed > 10"}},
        signals=[SPEED],
        when="size(members) == 1",
        evaluation={"every": "1s"},
    )
    engine = an_engine(a_detector(), rule)
    assert reported(engine.advance(ARRIVALS, at(1))) == ["r ~fleet started 1"]
    assert reported(engine.advance([arrival(1.5, "b", {"v": 11})], at(2))) == ["r ~fleet Until 2"]
    assert engine.counters.rules["r"].absences  # that b was no member for want of a value


def test_loops_cover_members_only() -> None:
    fast = "members.exists(m, m.speed > 10)"
    rule = a_rule(scope={"fleet": {"members": "client != 'a'"}}, signals=[SPEED], when=fast, evaluation={"every": "1s"})
    engine = an_engine(a_detector(), rule)
    assert reported(engine.advance(ARRIVALS, at(1))) == []
    assert reported(engine.advance([arrival(1.5, "b", {"v": 11})], at(2))) == ["r ~fleet started 2"]


def test_an_empty_fleet_is_evaluated_too() -> None:
    rule = a_rule(
        scope={"fleet": {"members": "true"}}, when="size(members) == 0 && members.all(m, m.client == 'a')",
        evaluation={"every": "1s"},
    )  # fmt: skip
    engine = an_engine(a_detector(clientTimeout="1s"), rule)
    assert reported(engine.advance([], at(2))) == ["r ~fleet started 1"]
    assert reported(engine.advance([arrival(2.5, "a", {"v": 1})], at(5))) == ["r ~fleet Until 3", "r ~fleet started 4"]
