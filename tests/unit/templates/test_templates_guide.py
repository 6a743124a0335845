"""The examples in docs/templates.md work as described."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import yaml

from application_manager.commands.offline import render_objects
from application_manager.core.objects.policy import Policy
from detector.engine.episodes.demands import to_task
from tests.driving import Drive, a_detector, a_stream, arrival
from tests.guides import guide, yaml_blocks
from tests.unit.manager_objects import NOW
from wayside.api import ApplicationTask, EventRule
from wayside.api.documents import parse_object
from wayside.api.parameter import Merge, Parameter

GUIDE = guide("templates")
BLOCKS = yaml_blocks(GUIDE)
OBJECTS = [parse_object(each) for block in BLOCKS for each in yaml.safe_load_all(block)]


RULE = next(each for each in OBJECTS if isinstance(each, EventRule))
DETECTOR = a_detector(a_stream("uplink"))


def instance(*without: str, and_tasks: Iterable[ApplicationTask] = ()) -> dict[str, Any]:
    given = [each for each in OBJECTS if each.name not in without and not isinstance(each, EventRule)]
    objects = [*given, *and_tasks]
    rendered = render_objects(objects, Policy(), NOW)
    assert rendered.refusals == []
    (found,) = [each for each in rendered.objects if each["kind"] == "ApplicationInstance"]
    parameters: dict[str, Any] = found["spec"]["parameters"]
    return parameters


def test_the_tasks_give_the_results_in_the_text() -> None:
    merged = {"region": "north", "detail": "low", "sources": ["car1", "car2", "car3"], "uplink": 100, "rateHz": 2}
    assert instance() == merged
    assert instance("thin-network") == {**merged, "rateHz": 20}


def test_the_rule_reconfigures_and_suspends() -> None:
    drive = Drive(DETECTOR, RULE)
    drive.take(arrival(0.5, "car1", {"mbit": 3}, "uplink"), until=1)
    emitted = [to_task(each) for each in drive.engine.demands().values()]
    assert {each.spec.template_name: each.spec.operation for each in emitted} == {
        "scene-fusion": "Reconfigure",
        "map-builder": "Suspend",
    }
    fusion = [each for each in emitted if each.spec.template_name == "scene-fusion"]
    assert instance("thin-network")["rateHz"] == 20
    assert instance("thin-network", and_tasks=fusion)["rateHz"] == 2
    drive.take(arrival(11.5, "car1", {"mbit": 30}, "uplink"), until=12)
    assert drive.engine.demands() == {}


def test_the_tables_name_all_strategies_and_fields() -> None:
    assert set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| `[A-Z].*? \|", GUIDE, re.MULTILINE)))) >= set(Merge)
    described = set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| `[a-z].*? \|", GUIDE, re.MULTILINE))))
    assert described == set(Parameter.model_fields) - {"description"}
