"""Errors of a rule are reported at their field, with the remedy; a valid rule is compiled."""

from __future__ import annotations

from typing import Any

import pytest

from tests.driving import POSITION, SECOND, a_deploy, a_detector, a_rule, a_stream
from wayside.api.eventrule import Aggregate
from wayside.rules import ClientSubject, Fields, PairSubject, RuleError, compile_rule, compile_stream

SPEED = {"name": "v", "stream": "speed", "value": "msg.v"}
PAIRS = {"pairs": {"position": POSITION, "within": 250}}
FLEET = {"fleet": {"members": "true"}}


def problems(fields: dict[str, Fields] | None = None, **spec: Any) -> dict[str, str]:
    """The messages by field."""
    with pytest.raises(RuleError) as caught:
        compile_rule(a_rule(**{"when": "true", **spec}), a_detector(), fields)
    texts = [str(problem).partition(": ")[::2] for problem in caught.value.problems]
    assert str(caught.value) == "; ".join(map(str, caught.value.problems))
    return dict(texts)


@pytest.mark.parametrize(
    ("spec", "field", "parts"),
    [
        (
            {"signals": [SPEED | {"stream": "sped"}]},
            "spec.signals[0].stream",
            ["no stream sped", "did you mean speed?"],
        ),
        ({"signals": [SPEED | {"stream": "zzz"}]}, "spec.signals[0].stream", ["no stream zzz", "it has pose, speed"]),
        (
            {"signals": [SPEED, {"name": "w", "of": "v > 1", "over": "9s", "lag": "2s", "aggregate": "Any"}]},
            "spec.signals[1].lag",
            ["over and lag reach back 11 s", "the 10s that Detector d keeps", "or raise buffer.duration"],
        ),
        (
            {"signals": [{"name": "w", "of": "u"}, {"name": "u", "of": "w", "lag": "1s"}]},
            "spec.signals[0].of",
            ["w depends on itself", "remove one of the signals that it reads"],
        ),
        (
            {"signals": [SPEED, {"name": "w", "of": "v", "over": "Episode", "aggregate": "Min"}], "until": "w < 1"},
            "spec.until",
            ["w is known only while an episode is open", "use it in actions"],
        ),
        ({"signals": [SPEED, {"name": "w", "of": "vv > 1"}]}, "spec.signals[1].of", ["`vv` is not declared"]),
        (
            {"scope": PAIRS, "signals": [SPEED, {"name": "w", "of": "distance"}], "when": "a.w > 1"},
            "spec.when",
            ["w", "a"],
        ),
        (
            {"signals": [SPEED, SPEED | {"name": "w", "over": "11s"}]},
            "spec.signals[1].over",
            ["11s is longer than the 10 s", "stream speed", "shorten it, or raise the stream's buffer.duration"],
        ),
        (
            {"signals": [SPEED | {"name": "client"}]},
            "spec.signals[0].name",
            [
                "the scope client already defines the variable",
                "the client's name",
                "choose another name, such as clientValue",
            ],
        ),
        (
            {"signals": [SPEED | {"name": "distance"}], "scope": PAIRS},
            "spec.signals[0].name",
            [
                "the scope pairs already defines the variable",
                "the distance of the two in metres",
                "such as distanceValue",
            ],
        ),
        (
            {"signals": [SPEED | {"name": "members"}, SPEED | {"name": "membersValue"}], "scope": FLEET},
            "spec.signals[0].name",
            ["the scope fleet already defines the variable", "such as membersValue2"],
        ),
        (
            {"signals": [SPEED | {"name": "for"}]},
            "spec.signals[0].name",
            ["for is a reserved word of CEL", "such as forValue"],
        ),
        (
            {"signals": [SPEED | {"name": "list"}]},
            "spec.signals[0].name",
            ["list is the name of a CEL type", "such as listValue"],
        ),
        (
            {"signals": [SPEED | {"name": "in"}], "scope": PAIRS},
            "spec.signals[0].name",
            ["in is a reserved word of CEL"],
        ),
        ({"signals": [SPEED | {"value": "mgs.v"}]}, "spec.signals[0].value", ["column 1", "did you mean `msg`?"]),
        (
            {"signals": [SPEED | {"value": "sample.siz"}]},
            "spec.signals[0].value",
            ["no field siz", "did you mean size?"],
        ),
        ({"signals": [SPEED | {"where": "msg.v + 1"}]}, "spec.signals[0].where", ["must be a boolean; got a number"]),
        ({"when": "v >", "signals": [SPEED]}, "spec.when", ["line 1, column 4", "the expression is incomplete"]),
        ({"when": "1 + 2"}, "spec.when", ["line 1, column 1", "must be a boolean; got a number"]),
        ({"when": "v > 1 and v < 3", "signals": [SPEED]}, "spec.when", ["column 7", "in CEL, write `&&`"]),
        ({"when": "true\n  && client > 2"}, "spec.when", ["line 2, column 13", "does not take (string, double)"]),
        (
            {"when": "points in streams"},
            "spec.when",
            ["`points` is not declared", "inside those of YAML", "'\"points\"'"],
        ),
        ({"until": "distance > 200"}, "spec.until", ["`distance` is not declared here"]),
        ({"scope": {"client": {"where": "v > 1"}}, "signals": [SPEED]}, "spec.scope.client.where", ["`v` is not"]),
        ({"scope": PAIRS, "when": "a.vv > 3", "signals": [SPEED]}, "spec.when", ["no field vv", "did you mean v?"]),
        ({"scope": PAIRS, "when": "b.position.w > 3"}, "spec.when", ["b.position has no field w", "it has x, y, z"]),
        ({"scope": PAIRS, "when": "distanc > 3"}, "spec.when", ["did you mean `distance`?"]),
        (
            {"actions": [a_deploy("one"), a_deploy("two", parameters={"ok": 1, "who": "${clien}"})]},
            "spec.actions[1].deploy.parameters.who",
            ["column 3", "did you mean `client`?"],
        ),
        (
            {"actions": [a_deploy("x", parameters={"script": ["echo ${HOME}"]})]},
            "spec.actions[0].deploy.parameters.script",
            ["script[0], line 1, column 8", "`HOME` is not declared", "write `$${` for a literal `${`"],
        ),
        (
            {"actions": [a_deploy("x", parameters={"open": "${client"})]},
            "spec.actions[0].deploy.parameters.open",
            ["`${` is not closed"],
        ),
        (
            {"scope": PAIRS, "actions": [a_deploy("x", parameters={"v": 1, "who": {"names": ["${[a.clent]}"]}})]},
            "spec.actions[0].deploy.parameters.who",
            ["a has no field clent", "did you mean client?"],
        ),
    ],
)
def test_a_problem_names_the_field_and_the_remedy(spec: dict[str, Any], field: str, parts: list[str]) -> None:
    message = problems(**spec)[field]
    assert all(part in message for part in parts), message


@pytest.mark.parametrize(
    ("axis", "source", "parts"),
    [
        ("x", "msg.x > 3", ["must be a number; got a boolean"]),
        ("y", "pose.y", ["`pose` is not declared here"]),
        ("z", "msg.", ["column 5: unexpected"]),
        ("stream", "poes", ["no stream poes", "did you mean pose?"]),
    ],
)
def test_a_problem_of_a_position_names_the_axis(axis: str, source: str, parts: list[str]) -> None:
    scope = {"pairs": {"position": {**POSITION, axis: source}, "within": 3}}
    message = problems(scope=scope)[f"spec.scope.pairs.position.{axis}"]
    assert all(part in message for part in parts), message


def test_all_problems_are_reported_at_once() -> None:
    found = problems(
        signals=[SPEED | {"stream": "sped", "where": "1"}, SPEED | {"name": "labels"}],
        when="spee > 3",
        until="1",
        actions=[a_deploy("x", parameters={"p": "${a}", "q": "${b}"})],
    )
    assert set(found) == {
        *("spec.signals[0].stream", "spec.signals[0].where", "spec.signals[1].name", "spec.when", "spec.until"),
        *("spec.actions[0].deploy.parameters.p", "spec.actions[0].deploy.parameters.q"),
    }


def test_fields_missing_in_the_message_type_are_reported_before_any_message() -> None:
    fields: dict[str, Fields] = {"speed": {"twist": {"linear": {"x": None}}, "list": None}}
    found = problems(
        fields,
        signals=[
            SPEED | {"value": "msg.twist.liner.x"},
            SPEED | {"name": "w", "value": "msg.list[0].anything", "where": "has(msg.twits)"},
        ],
    )
    assert "msg.twist has no field liner; did you mean linear?" in found["spec.signals[0].value"]
    assert "stream speed" in found["spec.signals[0].value"]
    assert "msg has no field twits; did you mean twist?" in found["spec.signals[1].where"]
    assert set(found) == {"spec.signals[0].value", "spec.signals[1].where"}


def test_a_rule_compiles_to_nanoseconds_and_the_detectors_defaults() -> None:
    rule = a_rule(
        signals=[
            SPEED | {"over": "5s", "aggregate": "Max"},
            {"name": "n", "stream": "pose", "over": "10s", "aggregate": "Count"},
        ],
        when="v > 3",
        evaluation={"every": "250ms"},
        cooldown="1m",
        actions=[a_deploy("x", priority=2, parameters={"v": "${v}"})],
        **{"for": "2s"},
    )
    compiled = compile_rule(rule, a_detector(clientTimeout="7s"))
    assert isinstance(compiled.subject, ClientSubject)
    assert (compiled.every_ns, compiled.for_ns, compiled.cooldown_ns) == (SECOND // 4, 2 * SECOND, 60 * SECOND)
    assert compiled.unknown_timeout_ns == 7 * SECOND
    assert compiled.until is None
    assert [(s.name, s.aggregate, s.over_ns) for s in compiled.signals] == [
        ("v", Aggregate.MAX, 5 * SECOND),
        ("n", Aggregate.COUNT, 10 * SECOND),
    ]
    (deploy,) = compiled.deploys
    assert (deploy.action, deploy.template, deploy.priority) == ("x", "app", 2)
    assert deploy.parameters.render({"v": 4.5}) == {"v": 4.5}
    pairs = compile_rule(a_rule(scope=PAIRS, when="distance < 9"), a_detector())
    assert isinstance(pairs.subject, PairSubject)
    assert pairs.subject.within == 250


BASE: dict[str, Any] = {"signals": [SPEED], "when": "v > 3"}


@pytest.mark.parametrize(
    ("change", "same"),
    [
        ({"when": "v > 4"}, False),
        ({"until": "v < 2"}, False),
        ({"for": "1s"}, False),
        ({"signals": [SPEED | {"value": "msg.w"}]}, False),
        ({"signals": [SPEED | {"over": "5s"}]}, False),
        ({"scope": {"client": {"where": "true"}}}, False),
        ({"scope": PAIRS, "when": "true"}, False),
        ({"cooldown": "1s"}, True),
        ({"evaluation": {"every": "2s"}}, True),
        ({"unknownTimeout": "2s"}, True),
        ({"actions": [a_deploy("x")]}, True),
        ({"description": "x", "dryRun": True, "enabled": False}, True),
        ({"scope": {"client": {}}, "for": "0s"}, True),  # the defaults, spelt out
    ],
)
def test_the_digest_covers_all_fields_that_decide_about_episodes(change: dict[str, Any], same: bool) -> None:
    detector = a_detector()
    before = compile_rule(a_rule(**BASE), detector).digest
    assert (compile_rule(a_rule(**{**BASE, **change}), detector).digest == before) is same


def test_a_streams_stamp_is_checked_like_a_rules_expressions() -> None:
    for source, part in (
        ("msg.t > 3", "must be a number"),
        ("mgs.t", "did you mean `msg`?"),
        ("msg.", "unexpected `.`"),
    ):
        stream = a_detector(a_stream("s", stamp=source)).spec.streams[0]
        with pytest.raises(RuleError) as caught:
            compile_stream(stream, 4)
        (problem,) = caught.value.problems
        assert str(problem).startswith("spec.streams[4].stamp: line 1")
        assert part in problem.message
    stream = a_detector(a_stream("s", stamp="msg.tt")).spec.streams[0]
    with pytest.raises(RuleError, match=r"msg has no field tt; did you mean t\?"):
        compile_stream(stream, 0, {"t": None})
    assert compile_stream(stream, 0).stamp is not None


def test_types_unknown_at_compile_time_are_checked_at_evaluation() -> None:
    rule = a_rule(signals=[SPEED], when="v > 3 && v.deep[0] == 'x'")
    assert compile_rule(rule, a_detector()).when.evaluate({"v": 1.0}) is False


@pytest.mark.parametrize(
    ("name", "scope"),
    [
        ("distance", {"client": {}}),
        ("a", {"client": {}}),
        ("position", FLEET),
        ("members", PAIRS),
        ("msg", {"client": {}}),
        ("key", PAIRS),
    ],
)
def test_names_of_other_scopes_are_free(name: str, scope: dict[str, Any]) -> None:
    rule = a_rule(scope=scope, signals=[SPEED | {"name": name}], when="true")
    assert [signal.name for signal in compile_rule(rule, a_detector()).signals] == [name]
