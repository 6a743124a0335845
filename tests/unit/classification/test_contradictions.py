"""Contradictions of classification and rule: for each kind a rule with a warning and a correct one."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from detector.commands.cli import app
from tests.driving import POSITION, a_detector, a_rule, a_stream
from tests.guides import guide
from wayside.api.classification import SCHEME, Classification
from wayside.process import commandline
from wayside.rules import compile_rule
from wayside.rules.contradictions import CONTRADICTIONS, contradictions

DETECTOR = a_detector(
    a_stream("pose"),
    a_stream("speed"),
    {"name": "vam", "key": "etsi/vam", "encoding": "uper", "type": "etsi/vam", "client": "vru"},
    {"name": "spat", "key": "etsi/spatem", "encoding": "uper", "type": "etsi/spatem", "client": "rsu"},
    {"name": "any-its", "key": "etsi/x", "encoding": "uper", "client": "its"},
    buffer={"duration": "48h"},
    recordings={"path": "/recordings"},
    database={"uriVariable": "WAYSIDE_DATABASE"},
)

GUIDE = guide("classification")

SPEED = {"name": "v", "stream": "speed", "value": "msg.v"}
PAIRS = {"pairs": {"position": POSITION, "within": 100}}
FLEET = {"fleet": {"members": "v > 1"}}
PLUGIN = {"name": "p", "plugin": {"name": "unmatched-objects"}}


def over(time: str, name: str = "m") -> dict[str, Any]:
    return {"name": name, "stream": "speed", "value": "msg.v", "over": time, "aggregate": "Max"}


def a_model(*inputs: dict[str, Any]) -> dict[str, Any]:
    return {"name": "risk", "model": {"file": "/m.onnx", "inputs": list(inputs or ({"name": "x", "signals": ["v"]},))}}


def act(*actions: dict[str, Any]) -> list[dict[str, Any]]:
    return [{"name": f"a{index}", **action} for index, action in enumerate(actions)]


DEPLOY = {"deploy": {"templateName": "app"}}
RECONFIGURE = {"deploy": {"templateName": "app", "operation": "Reconfigure"}}
SUSPEND = {"deploy": {"templateName": "app", "operation": "Suspend"}}
RECORD = {"record": {"streams": ["speed"]}}
DATABASE = {"database": {"streams": ["speed"]}}
DRY = {"database": {"streams": ["speed"], "dryRun": True}}
TRIGGER = {"trigger": {"detector": {"name": "other"}}}
CALL = {"trigger": {"http": {"start": {"url": "http://h/x"}}}}
ALERT = {"notify": {"alertmanager": {"url": "http://h"}}}
REPORT = {"notify": {"zenoh": {"key": "k"}}}
LATER = {"notify": {"zenoh": {"key": "k"}, "grouping": {"wait": "5s"}}}


def reported(classification: dict[str, list[str]], *others: Any, **spec: Any) -> list[str]:
    """The warnings of a rule with signal v and condition v > 1, unless given otherwise."""
    full = {"signals": [SPEED], "when": "v > 1", **spec}
    rule = a_rule("r", classification=classification, **full)
    named = {other.name: other for other in others}
    return [str(each) for each in contradictions(rule, compile_rule(rule, DETECTOR), DETECTOR, named)]


class ContradictionCase(NamedTuple):
    """A rule with a warning: the field, a part of the message, and the correction."""

    given: dict[str, list[str]]
    spec: dict[str, Any]
    shows: str
    right: dict[str, list[str]]


def way(dimension: str, value: str, shows: str, right: str, **spec: Any) -> ContradictionCase:
    return ContradictionCase(
        {dimension: value.split()}, spec, f"spec.classification.{dimension}{shows}", {dimension: right.split()}
    )


NOW = [SPEED]
DECIDING = {"signals": [over("2h")], "when": "m > 1"}
WAYS = [
    way("typeOfParticipants", "Vehicle", ": the messages of the stream vam (etsi/vam) are sent by VRU (", "Vehicle VRU",
        signals=[{"name": "v", "stream": "vam", "value": "msg.v"}]),
    way("typeOfParticipants", "Vehicle", ": the messages of the stream spat (etsi/spatem) are sent by RoadInfra",
        "Vehicle RoadInfrastructure", signals=[{"name": "v", "stream": "spat", "value": "msg.v"}]),
    way("numberOfParticipants", "One", "[0]: One (a single participant) contradicts the rule: spec.scope.pairs is "
        "about two clients: write Two, or Multiple", "Two", scope=PAIRS, when="distance < 5"),
    way("numberOfParticipants", "One", "[0]: One (a single participant) contradicts the rule: spec.scope.fleet",
        "Multiple", scope=FLEET, when="size(members) > 3.0"),
    ContradictionCase({"numberOfParticipants": ["One"], "eventDetectionEntity": ["External"]}, {},
        "spec.classification.eventDetectionEntity[0]: External (the detecting entity is the source of neither",
        {"numberOfParticipants": ["Two"], "eventDetectionEntity": ["External"]}),
    way("actingEntity", "External", "[0]: External (the acting entity is another one) "
        "contradicts the rule: the detector itself carries out spec.actions[0].record, spec.actions[1].database: "
        "write EventDetectionEntity", "EventDetectionEntity", actions=act(RECORD, DATABASE)),
    way("observationPeriod", "Immediate", "[0]: Immediate (a single sample is enough to detect the event) "
        "contradicts the rule: it looks back 2h (spec.signals[0].over: 2h): write LongTerm", "LongTerm", **DECIDING),
    way("observationPeriod", "Immediate", "[0]: Immediate (a single sample is enough to detect the event) "
        "contradicts the rule: it looks back 2s (spec.for: 2s): write ShortTerm", "ShortTerm", **{"for": "2s"}),
    way("observationPeriod", "Immediate", "[0]: Immediate (a single sample is enough to detect the event) "
        "contradicts the rule: it looks back 2500ms (spec.signals[0].over: 1500ms and spec.for: 1s): write ShortTerm",
        "ShortTerm", signals=[over("1500ms")], when="m > 1", **{"for": "1s"}),
    way("observationPeriod", "ShortTerm", "[0]: ShortTerm (the detection needs data of seconds to minutes) "
        "contradicts the rule: it uses only the newest samples: write Immediate", "Immediate"),
    way("observationPeriod", "ShortTerm", "[0]: ShortTerm (the detection needs data of seconds to minutes) "
        "contradicts the rule: it looks back 2h", "ShortTerm LongTerm", **DECIDING),
    way("observationPeriod", "LongTerm", "[0]: LongTerm (the detection needs data of hours or more) contradicts the "
        "rule: it looks back 1m (spec.signals[0].over: 1m): write ShortTerm", "ShortTerm",
        signals=[over("1m")], when="m > 1"),
    way("timeSensitivity", "Immediate", "[0]: Immediate (the consequences are immediate) contradicts the "
        "rule: it is evaluated every 10s (spec.evaluation.every): shorten it", "ShortTerm",
        evaluation={"every": "10s"}),
    way("timeSensitivity", "Immediate", "[0]: Immediate (the consequences are immediate) contradicts the "
        "rule: spec.actions[0].notify.grouping.wait: 5s: shorten it", "ShortTerm", actions=act(LATER)),
    way("timeSensitivity", "ShortTerm", "[0]: ShortTerm (the consequences follow within seconds to minutes) "
        "contradicts the rule: it is evaluated every 1h (spec.evaluation.every): shorten it, or write LongTerm",
        "LongTerm", evaluation={"every": "1h"}),
    way("incidence", "Rare", "[0]: Rare (seldom, as an exception) contradicts the rule: spec.when: true "
        "is always true: write Frequent", "Frequent", when="true"),
    way("detectionAlgorithm", "RuleBased", "[0]: RuleBased (rules or heuristics detect the event) contradicts the "
        "rule: spec.signals[1].model is a learnt model: add LearningBased", "RuleBased LearningBased",
        signals=[SPEED, a_model()], when="risk > 0.5"),
    way("detectionAlgorithm", "LearningBased", "[0]: LearningBased (an algorithm learnt from data detects the "
        "event) contradicts the rule: the conditions use no signal of a model or plugin: write RuleBased",
        "RuleBased"),
    way("typeOfAction", "Notification", ": spec.actions[0].deploy launches software: add Deployment (the action "
        "starts software that was not running)", "Deployment Notification", actions=act(DEPLOY)),
    way("typeOfAction", "Other", ": spec.actions[0].deploy reconfigures running applications, and starts none: add",
        "Reconfiguration Other", actions=act(RECONFIGURE)),
    way("typeOfAction", "Notification", ": spec.actions[0].deploy stops running applications: add Reconfiguration (the "
        "action changes the configuration of existing software) or Other (any other action)", "Reconfiguration",
        actions=act(SUSPEND)),
    way("typeOfAction", "Other", ": spec.actions[0].record records data: add DataCollection (the act",
        "DataCollection",
        actions=act(RECORD)),
    way("typeOfAction", "Other", ": spec.actions[0].database records data: add DataCollection", "DataCollection",
        actions=act(DATABASE)),
    way("typeOfAction", "Other", ": spec.actions[0].trigger records data: add DataCollection", "DataCollection",
        actions=act(TRIGGER)),
    way("typeOfAction", "DataCollection", ": spec.actions[1].notify raises an alert: add Notification (the action inf",
        "DataCollection Notification", actions=act(RECORD, ALERT)),
    way("typeOfAction", "DataCollection", ": spec.actions[0].notify sends a notification: add Reconfiguration",
        "Reconfiguration", actions=act(REPORT)),
    way("typeOfAction", "DataCollection Deployment", "[1]: Deployment (the action starts software that was not running)"
        " contradicts the rule: no action of the rule is of this type (spec.actions[0].record): remove it, or add the "
        "action",
        "DataCollection", actions=act(RECORD)),
    way("typeOfAction", "Reconfiguration Deployment", "[1]: Deployment (the action starts software that was not run"
        "ning) contradicts the rule: no action of the rule is of this type (spec.actions[0].deploy)", "Reconfiguration",
        actions=act(RECONFIGURE)),
]  # fmt: skip


@pytest.mark.parametrize("given_way", WAYS, ids=lambda each: each.shows.removeprefix("spec.classification.")[:60])
def test_a_contradiction_is_reported_and_the_corrected_rule_is_not(given_way: ContradictionCase) -> None:
    warnings = reported(given_way.given, **given_way.spec)
    assert any(warning.startswith(given_way.shows) for warning in warnings), warnings
    assert reported(given_way.right, **given_way.spec) == []
    assert reported({}, **given_way.spec) == []


def test_there_is_a_rule_for_each_entry_of_the_table() -> None:
    assert {given_way.shows.split(".")[2].split(":")[0].split("[")[0] for given_way in WAYS} == {
        dimension.name for dimension in SCHEME if dimension.values in {each.dimension for each in CONTRADICTIONS}
    }


RIGHT: dict[str, tuple[str, str, dict[str, Any]]] = {
    "only an action reads it": ("observationPeriod", "Immediate", {"signals": [SPEED, over("2h")]}),
    "the newest sample, if it is not too old": (
        "observationPeriod", "Immediate", {"signals": [over("2h") | {"aggregate": "Last"}], "when": "m > 1"}
    ),
    "one second is not a couple": ("observationPeriod", "Immediate", {"scope": PAIRS, "when": "closingSpeed > 3"}),
    "a second is more than a sample": ("observationPeriod", "ShortTerm", {"scope": PAIRS, "when": "closingSpeed > 3"}),
    "a plugin remembers": ("observationPeriod", "LongTerm", {"signals": [PLUGIN], "when": "p"}),
    "an age may be any": (
        "observationPeriod", "ShortTerm",
        {"signals": [{"name": "age", "stream": "speed", "aggregate": "Age"}], "when": "age > 7"},
    ),
    "one of several fits": ("observationPeriod", "Immediate LongTerm", {}),
    "the first action counts": ("timeSensitivity", "Immediate", {"actions": act(LATER, REPORT)}),
    "on each sample": ("timeSensitivity", "Immediate", {"evaluation": {"onSample": "speed"}}),
    "messages of all kinds": (
        "typeOfParticipants", "Vehicle", {"signals": [{"name": "v", "stream": "any-its", "value": "msg.v"}]}
    ),
    "a report, as in Table 2": ("typeOfAction", "Notification", {"actions": act(RECORD, REPORT)}),
    "a notified reconfiguration": ("typeOfAction", "Reconfiguration", {"actions": act(REPORT)}),
    "nothing is written": ("typeOfAction", "Notification", {"actions": act(DRY, REPORT)}),
    "a call may do anything": ("typeOfAction", "Reconfiguration", {"actions": act(CALL)}),
    "somebody else acts on the events": ("typeOfAction", "Deployment", {}),
    "what is launched records": ("typeOfAction", "Deployment DataCollection", {"actions": act(DEPLOY)}),
    "not all actions record": ("actingEntity", "External", {"actions": act(RECORD, REPORT)}),
    "a plugin may have learnt": ("detectionAlgorithm", "LearningBased", {"signals": [PLUGIN], "when": "p"}),
    "what it looks at was learnt": ("detectionAlgorithm", "RuleBased LearningBased", {}),
    "the model decides nothing": ("detectionAlgorithm", "RuleBased", {"signals": [SPEED, a_model()]}),
    "not known to hold always": ("incidence", "Rare", {"when": "v > 1 || true"}),
}  # fmt: skip


@pytest.mark.parametrize("case", RIGHT)
def test_a_classification_that_may_be_right_gives_no_warning(case: str) -> None:
    dimension, values, spec = RIGHT[case]
    assert reported({dimension: values.split()}, **spec) == []


def test_signals_of_a_referenced_rule_count_too() -> None:
    spec = {
        "signals": [{"name": "starts", "ruleName": "other", "over": "30m", "aggregate": "Count"}],
        "when": "starts > 2",
    }
    other = a_rule("other", signals=[over("40m"), a_model({"name": "x", "signals": ["m"]})], when="risk > 0.5")
    (period,) = reported({"observationPeriod": ["ShortTerm"]}, other, **spec)
    assert "it looks back 70m (spec.signals[0].over: 30m and spec.signals[0].over: 40m of the rule other)" in period
    (learnt,) = reported({"detectionAlgorithm": ["RuleBased"]}, other, **spec)
    assert "spec.signals[1].model of the rule other is a learnt model" in learnt
    assert reported({"observationPeriod": ["LongTerm"], "detectionAlgorithm": ["LearningBased"]}, other, **spec) == []


def test_a_models_window_counts_and_a_sample_window_has_no_length() -> None:
    def model(**window: Any) -> dict[str, Any]:
        return {
            "signals": [SPEED, a_model({"name": "x", "window": {"signals": ["v"], **window}})], "when": "risk > 0.5"
        }  # fmt: skip

    (warning,) = reported({"observationPeriod": ["Immediate"]}, **model(over="5s", samples=10))
    assert "it looks back 5s (spec.signals[1].model: 5s): write ShortTerm" in warning
    for value in ("Immediate", "ShortTerm", "LongTerm"):
        assert reported({"observationPeriod": [value]}, **model(last=10)) == []


PAPER = {
    "2": ("Safety Efficiency|Vehicle|One|EventSourceEntity|EventSourceEntity|External|External|Participant|ShortTerm"
          "|LongTerm|Rare|RuleBased|Notification", act(RECORD, ALERT)),
    "6": ("Safety|Vehicle|One|EventSourceEntity|DataSourceEntity|EventDetectionEntity|ActingEntity|Participant "
          "BeyondEnvironment|ShortTerm|ShortTerm|Common|RuleBased LearningBased|DataCollection", act(RECORD)),
}  # fmt: skip


@pytest.mark.parametrize("table", PAPER)
def test_the_papers_own_classifications_do_not_contradict_rules_that_follow_it(table: str) -> None:
    text, actions = PAPER[table]
    values = {each.name: part.split() for each, part in zip(SCHEME, text.split("|"), strict=True)}
    assert reported(values, signals=[over("10s")], when="m > 1", actions=actions) == []


@given(
    st.fixed_dictionaries(
        {d.name: st.lists(st.sampled_from([v.value for v in d.values]), unique=True) for d in SCHEME}
    ),
    st.sampled_from([given_way.spec for given_way in WAYS]),
)
def test_each_warning_is_at_a_value_that_is_given_and_has_its_definition(
    values: dict[str, list[str]], spec: dict[str, Any]
) -> None:
    classification = Classification.model_validate(values)
    full = {"signals": [SPEED], "when": "v > 1", **spec}
    rule = a_rule("r", classification=values, **full)
    for each in contradictions(rule, compile_rule(rule, DETECTOR), DETECTOR, {}):
        dimension = next(dimension for dimension in SCHEME if dimension.name == each.path[2])
        if len(each.path) == 4:
            index = each.path[3]
            assert isinstance(index, int)
            assert each.message.startswith(classification.values_of(dimension)[index].explained())
        else:
            assert any(value.explained() in each.message for value in dimension.values)


def test_the_guide_lists_them_all() -> None:
    section = GUIDE.split("## Contradictions", 1)[1].split("\n## ", 1)[0]
    rows = [line for line in section.splitlines() if line.startswith("| `")]
    names = {dimension.values: dimension.name for dimension in SCHEME}
    assert rows == [f"| `{names[each.dimension]}` | {each.description} |" for each in CONTRADICTIONS]


RULES = """\
apiVersion: wayside.dev/v1alpha1
kind: EventRule
metadata: {name: fast}
spec:
  classification:
    observationPeriod: [ShortTerm]
    typeOfAction:
      - Notification
  signals: [{name: v, stream: speed, value: msg.v}]
  when: v > 20
  actions: [{name: start, deploy: {templateName: app}}]
"""


def check(folder: Path, *options: str) -> int:
    (folder / "rules.yaml").write_text(RULES)
    detector = {"streams": [a_stream("speed")]}
    (folder / "detector.yaml").write_text(
        yaml.safe_dump(
            {"apiVersion": "wayside.dev/v1alpha1", "kind": "Detector", "metadata": {"name": "d"}, "spec": detector}
        )
    )
    return commandline.run_cli(app, "detector", (), ["check", str(folder), *options])


def test_check_reports_where_it_is_and_only_strict_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert check(tmp_path) == 0
    lines = capsys.readouterr().err.splitlines()
    rules = tmp_path / "rules.yaml"
    assert lines[0].startswith(f"{rules}:6:25: warning: spec.classification.observationPeriod[0]: ShortTerm (the det")
    assert lines[1].startswith(
        f"{rules}:8:7: warning: spec.classification.typeOfAction: spec.actions[0].deploy launches"
    )
    assert lines[2:] == ["1 Detector, 1 EventRule: no errors, 2 warnings"]
    assert check(tmp_path, "--strict") == 1
    assert capsys.readouterr().err.splitlines()[:2] == lines[:2]
