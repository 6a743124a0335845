"""Plugin signals: found, checked, evaluated for each subject of every scope, with state of its own; they may fail."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from detector.assembly.checking import findings
from detector.plugins.instances import OFFERS, LocalHost, plain_value
from tests.driving import POSITION, START, a_detector, a_stream, arrival, at
from tests.plugins.rules import PluginDrive, plugin_rule, plugins
from wayside.api import EventRule
from wayside.api.documents import load_documents

__all__ = ["plugins"]  # a fixture

pytestmark = pytest.mark.usefixtures("plugins")

RULES = """\
apiVersion: wayside.dev/v1alpha1
kind: EventRule
metadata: {name: r}
spec:
  signals:
    - name: p
      plugin:
        name: %s
        parameters: %s
  when: %s
"""


def drive(*rules: EventRule, **spec: Any) -> PluginDrive:
    return PluginDrive(a_detector(**spec), *rules, host=LocalHost())


def problems(tmp_path: Path, plugin: str, parameters: str, when: str = "p.count > 3") -> list[str]:
    (tmp_path / "d.json").write_text(a_detector().model_dump_json(by_alias=True, exclude_none=True))
    (tmp_path / "r.yaml").write_text(RULES % (plugin, parameters, when))
    found = findings(load_documents([tmp_path])).problems
    return [str(problem).removeprefix(f"{tmp_path}/") for problem in found]


def test_installed_and_shipped_plugins_are_found() -> None:
    assert {"counting", "strange", "unmatched-objects"} <= OFFERS.installed().keys()


def test_a_missing_plugin_is_reported_with_the_existing_ones(tmp_path: Path) -> None:
    (problem,) = problems(tmp_path, "countin", "{stream: speed}")
    assert problem.startswith("r.yaml:8:15: spec.signals[0].plugin.name: no plugin countin is installed")
    assert "did you mean counting?" in problem
    (problem,) = problems(tmp_path, "xyz", "{}")
    assert "there are broken, counting, not-a-plugin, strange, unmatched-objects" in problem


@pytest.mark.parametrize(
    ("plugin", "parameters", "reported"),
    [
        ("counting", "{}", "r.yaml:9:21: spec.signals[0].plugin.parameters.stream: is missing: add it"),
        ("counting", "{stream: spede}", "parameters.stream: the Detector has no stream spede; did you mean speed?"),
        ("counting", "{stream: speed, limit: x}", "parameters.limit: must be a valid number"),
        ("counting", "{stream: speed, raisAt: 3}", "parameters.raisAt: unknown field"),
        (
            "not-a-plugin",
            "{}",
            "plugin.name: plugin not-a-plugin must be a complete subclass of detector.plugins.base.Plugin",
        ),
        ("broken", "{}", "plugin.name: cannot load plugin broken: ModuleNotFoundError"),
    ],
)
def test_a_rejection_by_a_plugin_is_reported_by_field(
    tmp_path: Path, plugin: str, parameters: str, reported: str
) -> None:
    (problem,) = problems(tmp_path, plugin, parameters)
    assert reported in problem


def test_a_rule_with_a_valid_plugin_has_no_problems(tmp_path: Path) -> None:
    assert problems(tmp_path, "counting", "{stream: speed, raiseAt: 4}") == []


@pytest.mark.parametrize(
    "signal",
    [
        {"name": "p"},
        {"name": "p", "stream": "speed", "plugin": {"name": "counting"}},
        {"name": "p", "plugin": {"name": "counting"}, "value": "1"},
        {"name": "p", "plugin": {"name": "counting"}, "aggregate": "Age"},
    ],
)
def test_a_signal_has_one_source_and_a_plugin_gives_the_value_itself(signal: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"exactly one of stream|cannot have value, where, over or aggregate"):
        plugin_rule(signals=[signal])


def test_each_client_has_its_own_state_until_it_is_lost() -> None:
    driven = drive(plugin_rule(), clientTimeout="3s")
    assert driven.take(arrival(0.5, "a", {"v": 1}), arrival(1.5, "b", {"v": 1}), until=2) == []
    assert driven.take(arrival(2.5, "b", {"v": 1}), until=3) == ["r a started 3"]
    assert driven.take(arrival(3.9, "b", {"v": 1}), until=4) == ["r a ClientLost 4", "r b started 4"]
    assert driven.take(arrival(4.5, "a", {"v": 1}), arrival(4.6, "b", {"v": 1}), until=6) == []
    assert driven.take(arrival(6.5, "a", {"v": 1}), until=7) == ["r a started 7"]


def test_a_client_that_was_away_between_two_evaluations_restarts() -> None:
    driven = drive(plugin_rule(when="p.count >= 2", evaluation={"every": "10s"}), clientTimeout="3s")
    driven.take(arrival(9.5, "a", {"v": 1}), until=10)
    assert driven.take(arrival(19.5, "a", {"v": 1}), until=20) == []
    assert driven.take(arrival(22, "a", {"v": 1}), arrival(24.9, "a", {"v": 1}), until=26) == []
    assert driven.take(arrival(27, "a", {"v": 1}), arrival(29, "a", {"v": 1}), until=30) == ["r a started 30"]


@pytest.mark.parametrize("clock", ["Wall", "Data"])
def test_with_each_sample_the_plugin_sees_that_sample_and_none_later(clock: str) -> None:
    rule = plugin_rule(when="p.v >= 5", evaluation={"onSample": "speed"})
    detector = a_detector(a_stream("speed", stamp="msg.t"), clock=clock, lateness="100ms")
    driven = PluginDrive(detector, rule, host=LocalHost())
    samples = [arrival(t, "a", {"v": v, "t": at(t) / 1e9}) for t, v in ((0.3, 1), (0.5, 6), (0.7, 2), (3.0, 7))]
    other = arrival(4.0, "b", {"v": 0, "t": at(4) / 1e9})
    assert driven.take(*samples, other, until=4) == ["r a started 0.5", "r a Until 0.7", "r a started 3"]
    assert [event.values["p"]["count"] for event in driven.events] == [2, 3, 4]


def test_the_value_is_in_the_event_and_in_the_actions() -> None:
    driven = drive(plugin_rule())
    driven.take(arrival(0.5, "a", {"v": 1}), until=3)
    assert driven.events[0].values == {"p": {"count": 3.0, "clients": ["a"], "v": 1.0}}


def test_the_plugin_has_one_value_for_a_pair_and_none_for_its_members() -> None:
    pairs = {"pairs": {"position": POSITION, "within": 10}}
    driven = drive(plugin_rule(when='p.count >= 2 && p.clients == ["a", "b"] && distance < 5', scope=pairs))
    for client, x in (("b", 0), ("a", 1), ("c", 100)):
        driven.take(arrival(0.5, client, {"x": x, "y": 0}, "pose"), arrival(0.6, client, {"v": 1}), until=0.7)
    assert driven.take(until=4) == ["r a+b started 2"]
    assert driven.events[0].values["p"] == {"count": 2.0, "clients": ["a", "b"], "v": 1.0}
    with pytest.raises(Exception, match=r"a has no field p|p"):
        drive(plugin_rule(when="a.p.count > 1", scope=pairs))


def test_a_pair_that_is_no_longer_evaluated_loses_its_state() -> None:
    pairs = {"pairs": {"position": POSITION, "within": 10}}
    driven = drive(plugin_rule(when="p.count >= 3 && false", scope=pairs, cooldown="0s"))
    instances = driven.host._signals["r", "p"]  # type: ignore[attr-defined]
    near = [arrival(0.5, "a", {"x": 0, "y": 0}, "pose"), arrival(0.6, "b", {"x": 0, "y": 0}, "pose")]
    driven.take(*near, arrival(0.7, "a", {"v": 1}), until=2)
    assert len(instances) == 1
    driven.take(arrival(2.5, "b", {"x": 99, "y": 0}, "pose"), until=3)
    assert len(instances) == 0


def test_the_plugin_sees_the_members_of_the_fleet_at_the_tick() -> None:
    driven = drive(plugin_rule(when="size(p.clients) == 2", scope={"fleet": {"members": 'client != "c"'}}))
    assert driven.take(arrival(0.5, "a", {"v": 1}), arrival(0.5, "c", {"v": 1}), until=1) == []
    assert driven.take(arrival(1.5, "b", {"v": 1}), until=2) == ["r ~fleet started 2"]
    assert driven.events[0].values["p"]["clients"] == ["a", "b"]


def test_a_plugin_exception_is_counted_and_makes_the_value_unknown_once() -> None:
    other = plugin_rule("other")
    driven = drive(plugin_rule(parameters={"raiseAt": 2}), other)
    driven.take(arrival(0.5, "a", {"v": 1}), arrival(1.5, "a", {"v": 2}), arrival(2.5, "a", {"v": 1}), until=3)
    assert [event.episode.rule for event in driven.events] == ["other", "r"]
    counters = driven.engine.counters.rule("r")
    assert counters.errors == 1
    assert counters.last_error.startswith("signal p: plugin counting: ValueError: 2 is not acceptable (signals.py:")
    assert driven.engine.counters.rule("other").errors == 0


def test_a_plugin_without_a_value_is_unknown_without_an_error() -> None:
    driven = drive(plugin_rule(when="p.count >= 1"))
    assert driven.take(arrival(0.5, "a", {"x": 0, "y": 0}, "pose"), until=4) == []
    counters = driven.engine.counters.rule("r")
    assert counters.errors == 0
    assert counters.absences["signal p: plugin counting returned no value"] == 4


def test_a_plugin_value_that_is_not_plain_data_is_an_error() -> None:
    driven = drive(plugin_rule(plugin="strange", when="size(p) > 0"))
    driven.take(arrival(0.5, "a", {"v": 1}), until=1)
    assert "the value is a set: return None, a boolean" in driven.engine.counters.rule("r").last_error


def test_a_jump_of_time_drops_all_plugin_state() -> None:
    driven = drive(plugin_rule())
    driven.take(arrival(0.5, "a", {"v": 1}), until=2)
    driven.note(driven.engine.gap(START + 3 * 10**9))
    assert driven.take(arrival(3.5, "a", {"v": 1}), until=5) == []
    assert driven.take(until=6) == ["r a started 6"]


def test_changed_plugin_parameters_change_the_rule() -> None:
    driven = drive(plugin_rule())
    driven.take(arrival(0.5, "a", {"v": 1}), until=3)
    from tests.driving import compiled

    events = driven.engine.set_rules(compiled(driven.detector, plugin_rule(parameters={"limit": 5})))
    assert driven.note(events) == ["r a RuleChanged 3"]
    assert driven.take(until=6) == ["r a started 6"]


@pytest.mark.parametrize(
    ("value", "made"),
    [
        ((1, [2.5, "x"], {"k": True}), [1.0, [2.5, "x"], {"k": True}]),
        (math.nan, None),
        (np.float32(0.5), 0.5),
        (np.int64(3), 3.0),
        (np.bool_(True), True),
        (2**60, 2**60),
        (math.inf, math.inf),
    ],
)
def test_plain_values_pass_as_doubles(value: Any, made: Any) -> None:
    assert plain_value(value) == made
    assert type(plain_value(value)) is type(made)


@pytest.mark.parametrize("value", [{1, 2}, b"x", object(), {1: 2}, np.zeros(3)])
def test_other_values_are_refused(value: Any) -> None:
    with pytest.raises(TypeError, match=f"the value is a {type(value).__name__}"):
        plain_value(value)


def test_a_recursive_value_is_rejected() -> None:
    loop: list[Any] = []
    loop.append(loop)
    with pytest.raises(TypeError, match="nested more than"):
        plain_value(loop)


def test_plugins_get_streams_and_queries(tmp_path: Path) -> None:
    driven = drive(plugin_rule(), streams=[a_stream("speed")])
    assert driven.engine.queries().streams("a") == []
