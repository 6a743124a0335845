"""Signals over rules: sequence, count, escalation, absence of a follow-up; their order and errors."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from detector.assembly import RuleIndex
from tests.driving import POSITION, SPEED, Drive, a_detector, a_rule, arrival, at, compiled, place
from wayside.rules import RuleError, dependency_problems, in_order


def over(rule: str, name: str = "it", **fields: Any) -> dict[str, Any]:
    return {"name": name, "ruleName": rule, **fields}


def count(rule: str, window: str, name: str = "it", **fields: Any) -> dict[str, Any]:
    return over(rule, name, over=window, aggregate="Count", **fields)


def braking(name: str = "braking", **spec: Any) -> Any:
    return a_rule(name, **{"signals": [SPEED], "when": "speed < 1", **spec})


def speeds(values: str, client: str = "car", start: float = 0.5) -> list[Any]:
    """One sample a second; a digit is its speed."""
    return [arrival(start + n, client, {"v": float(value)}) for n, value in enumerate(values)]


def test_a_count_of_starts_within_a_window_starts_a_rule_at_the_same_tick() -> None:
    often = a_rule("a-often", signals=[count("braking", "5s")], when="it >= 2")
    drive = Drive(a_detector(), often, braking())
    reported = drive.take(*speeds("50505555555"), until=11)
    assert reported == [
        "braking car started 2",
        "braking car Until 3",
        "braking car started 4",
        "a-often car started 4",  # after the rule that it depends on, although its name is smaller
        "braking car Until 5",
        "a-often car Until 7",  # the first start, at 2, is no longer in (2, 7]
    ]


def test_a_sequence_needs_the_second_to_follow_the_first() -> None:
    fast = a_rule("fast", signals=[SPEED], when="speed > 8")
    sequence = a_rule(
        "sequence",
        signals=[
            over("fast", "since", aggregate="Age"),
            count("fast", "3s"),
            over("braking", "now", aggregate="Active"),
        ],
        when="now && it > 0 && since > 0",
    )
    drive = Drive(a_detector(), sequence, fast, braking())
    assert [each for each in drive.take(*speeds("0950555509505"), until=13) if each.startswith("sequence")] == [
        "sequence car started 4",
        "sequence car Until 5",
        "sequence car started 12",
        "sequence car Until 13",
    ]


def test_the_absence_of_a_follow_up_within_a_time() -> None:
    moved = a_rule("moved", signals=[SPEED], when="speed > 8")
    absence = a_rule(
        "stuck",
        signals=[
            count("braking", "60s", "stops"),
            over("braking", "stopped", aggregate="Age"),
            over("moved", "moved", aggregate="Age"),
        ],
        when="stops > 0 && stopped >= 3 && moved >= stopped",
    )
    drive = Drive(a_detector(), absence, moved, braking())
    reported = drive.take(*speeds("055905555559"), until=12)
    assert [each for each in reported if each.startswith("stuck")] == ["stuck car started 8", "stuck car Until 12"]


def test_escalation_while_an_episode_is_open_and_how_it_began() -> None:
    worse = a_rule(
        "worse",
        signals=[over("slow", aggregate="Active"), over("slow", "before", value="msg.values.speed"), SPEED],
        when="it && speed < before",
    )
    drive = Drive(a_detector(), worse, braking("slow", when="speed < 5"))
    reported = drive.take(*speeds("943229"), until=6)
    assert reported == ["slow car started 2", "worse car started 3", "slow car Until 6", "worse car Until 6"]
    assert drive.events[1].values == {"it": True, "before": 4, "speed": 3}


def test_where_selects_starts_by_their_values() -> None:
    hard = a_rule("hard", signals=[count("slow", "10s", where="msg.values.speed < 2")], when="it > 0")
    drive = Drive(a_detector(), hard, braking("slow", when="speed < 5"))
    reported = drive.take(*speeds("939919"), until=6)
    assert [each for each in reported if each.startswith("hard")] == ["hard car started 5"]


def test_an_episode_of_a_pair_counts_for_both_clients() -> None:
    near = a_rule("near", scope={"pairs": {"position": POSITION, "within": 50}}, when="distance < 10")
    party = a_rule("party", signals=[over("near", aggregate="Active")], when="it")
    drive = Drive(a_detector(), near, party)
    places = [arrival(0.5, client, {"x": x, "y": 0}, "pose") for client, x in (("a", 0), ("b", 5), ("c", 500))]
    assert drive.take(*places, until=1) == ["near a+b started 1", "party a started 1", "party b started 1"]


def test_a_disabled_dependency_is_unknown_and_a_later_one_brings_its_open_episodes() -> None:
    detector = a_detector()
    top = a_rule("top", signals=[over("braking", aggregate="Active")], when="it", until="!it")
    drive = Drive(detector, top, braking(enabled=False))
    assert drive.take(*speeds("0"), until=1) == []
    assert drive.engine.counters.rule("top").absences["signal it: rule braking is disabled, refused or gone"] == 1
    drive.note(drive.engine.set_rules(compiled(detector, braking())))
    assert drive.take(until=2) == ["braking car started 2"]
    drive.note(drive.engine.set_rules(compiled(detector, braking(), top)))
    assert drive.take(until=3) == ["top car started 3"]
    assert drive.events[-1].episode.onset_time == at(3)


def test_a_dependency_with_a_changed_meaning_begins_without_starts() -> None:
    detector = a_detector()
    top = a_rule("top", signals=[count("braking", "10s")], when="it > 0")
    drive = Drive(detector, top, braking())
    assert drive.take(*speeds("0"), until=1) == ["braking car started 1", "top car started 1"]
    reported = drive.note(drive.engine.set_rules(compiled(detector, top, braking(when="speed < 0.5"))))
    assert reported == ["braking car RuleChanged 1"]
    assert drive.take(*speeds("9", start=1.5), until=2) == ["top car Until 2"]


def test_starts_do_not_keep_a_client_known_and_are_forgotten_with_it() -> None:
    top = a_rule("top", signals=[count("braking", "1h")], when="it > 0")
    drive = Drive(a_detector(clientTimeout="5s"), top, braking())
    reported = drive.take(*speeds("0"), *speeds("9", start=20.5), until=21)
    assert reported == [
        "braking car started 1",
        "top car started 1",
        "braking car ClientLost 6",
        "top car ClientLost 6",
    ]


def test_a_restored_episode_is_active_and_a_past_start() -> None:
    detector = a_detector()
    rule = braking(actions=[{"name": "go", "deploy": {"templateName": "app"}}])
    first = Drive(detector, rule)
    first.take(*speeds("0"), until=1)
    top = a_rule("top", signals=[over("braking", "since", aggregate="Age")], when="since == 9.0", until="false")
    second = Drive(detector, rule, top, start=5)
    second.note(second.engine.restore(list(first.engine.demands().values()), at(5)))
    assert second.take(*speeds("00000", start=5.5), until=10) == ["top car started 10"]


def test_rules_are_evaluated_by_depth_then_name() -> None:
    rules = [
        a_rule("a", signals=[count("c", "1s")], when="it > 0"),
        a_rule("b", signals=[count("a", "1s")], when="it > 0"),
        a_rule("c", when="true"),
        a_rule("d", when="true"),
    ]
    assert [rule.name for rule in in_order(compiled(a_detector(), *rules))] == ["c", "d", "a", "b"]
    circle = compiled(a_detector(), *rules[:2], a_rule("c", signals=[count("b", "1s")], when="it > 0"))
    assert sorted(rule.name for rule in in_order(circle)) == ["a", "b", "c"]


def test_a_cycle_is_reported_with_its_path_and_an_unknown_rule_with_a_similar_name() -> None:
    rules = [
        a_rule("a", signals=[count("b", "1s")], when="it > 0"),
        a_rule("b", signals=[SPEED, count("c", "1s")], when="it > 0"),
        a_rule("c", signals=[count("a", "1s")], when="it > 0"),
        a_rule("d", signals=[count("a", "1s")], when="it > 0"),
        a_rule("e", signals=[count("e", "1s")], when="it > 0"),
        a_rule("f", signals=[count("brakin", "1s")], when="it > 0"),
        a_rule("braking", when="true"),
    ]
    reported = {name: [str(problem) for problem in problems] for name, problems in dependency_problems(rules).items()}
    circle = "rules must not depend on each other in a cycle: {}; remove one of these signals"
    assert reported == {
        "a": ["spec.signals[0].ruleName: " + circle.format("a → b → c → a")],
        "b": ["spec.signals[1].ruleName: " + circle.format("b → c → a → b")],
        "c": ["spec.signals[0].ruleName: " + circle.format("c → a → b → c")],
        "e": ["spec.signals[0].ruleName: " + circle.format("e → e")],
        "f": [
            "spec.signals[0].ruleName: there is no rule brakin that the same Detector selects; did you mean braking?"
        ],
    }


def test_a_rule_over_an_unknown_rule_is_rejected_until_it_exists() -> None:
    index, top = RuleIndex(), a_rule("top", signals=[count("braking", "1s")], when="it > 0")
    good, refused = index.compile([top], a_detector(), {})
    assert (good, len(refused)) == ([], 1)
    good, refused = index.compile([top, braking()], a_detector(), {})
    assert ([rule.name for rule in good], refused) == (["top", "braking"], [])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"name": "s", "aggregate": "Count", "over": "1s"}, "exactly one of stream, ruleName, model, plugin and of"),
        ({"name": "s", "ruleName": "r", "stream": "s", "aggregate": "Count", "over": "1s"}, "exactly one of stream"),
        ({"name": "s", "stream": "s", "aggregate": "Active"}, "Active needs a signal with ruleName"),
        ({"name": "s", "ruleName": "r", "aggregate": "Active", "over": "1s"}, "without over and where"),
        ({"name": "s", "ruleName": "r", "aggregate": "Active", "value": "msg.episode"}, "uses no value"),
    ],
)
def test_invalid_signals_over_a_rule_are_rejected(fields: Any, message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        a_rule("r", signals=[fields], when="true")


def test_a_start_has_no_other_fields() -> None:
    top = a_rule("top", signals=[over("braking", value="msg.vales.speed")], when="it > 0.0")
    (refusal,) = RuleIndex().compile([top, braking()], a_detector(), {})[1]
    assert "spec.signals[0].value: msg has no field vales; did you mean values?" in str(refusal)


def test_ends_are_samples_at_their_times_with_the_reason_and_the_values_at_the_end() -> None:
    left = a_rule(
        "left",
        signals=[
            over(
                "braking", "lasted", samples="Ends", value="msg.endTime - msg.startTime", where="msg.reason == 'Until'"
            ),
            over("braking", "speed", samples="Ends", value="msg.values.speed"),
            over("braking", "since", samples="Ends", aggregate="Age"),
            count("braking", "5s", "ends", samples="Ends"),
            count("braking", "5s", "starts"),
        ],
        when="lasted == 2 && speed == 7 && since < 1 && ends == 1 && starts == 1",
        evaluation={"every": "500ms"},
    )
    drive = Drive(a_detector(), left, braking())
    assert {"left", "braking"} <= drive.engine.in_columns
    assert drive.take(*speeds("5007"), until=4.2) == [
        "braking car started 2",
        "braking car Until 4",
        "left car started 4",
    ]


def test_an_end_by_loss_counts_for_the_other_client_of_a_pair_alone() -> None:
    scope = {"pairs": {"position": POSITION, "within": 50}}
    near = a_rule("near", scope=scope, when="distance < 10")
    lost = [over("near", "reason", samples="Ends", value="msg.reason")]
    alone = a_rule("alone", signals=lost, when="reason == 'ClientLost'", evaluation={"every": "500ms"})
    drive = Drive(a_detector(clientTimeout="3s"), near, alone)
    reported = drive.take(*(place(n / 2, "a", 0) for n in range(1, 20)), until=0)
    reported = drive.take(
        place(9.6, "a", 0), place(9.7, "b", 1), *(place(n / 2, "a", 0) for n in range(20, 30)), until=14.9
    )
    assert reported == ["near a+b started 10", "near a+b ClientLost 13", "alone a started 13"]
    assert drive.take(place(15, "a", 0), place(15, "b", 30), until=16) == []


@pytest.mark.parametrize(
    "signal",
    [
        {"stream": "speed", "value": "msg.v", "samples": "Ends"},
        {"ruleName": "braking", "aggregate": "Active", "samples": "Ends"},
    ],
)
def test_ends_exist_only_for_rules_and_are_never_active(signal: dict[str, Any]) -> None:
    with pytest.raises(
        ValidationError, match="samples: Ends needs a signal with ruleName and an aggregate other than Active"
    ):
        a_rule(signals=[{"name": "s", **signal}], when="s")


def test_a_field_of_ends_is_rejected_for_starts() -> None:
    rule = a_rule(signals=[over("braking", value="msg.reason")], when="it == 'Until'")
    with pytest.raises(
        RuleError, match=r"signals\[0\].value: msg has no field reason; .*\(msg is an episode's start\)"
    ):
        compiled(a_detector(), rule)
