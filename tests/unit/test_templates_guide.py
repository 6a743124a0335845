"""The examples in docs/templates.md do what the text says."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from application_manager.core.policy import Policy
from application_manager.offline import render_objects
from tests.unit.driving import a_detector, a_stream
from tests.unit.manager_objects import NOW
from wayside.api import EventRule
from wayside.api.documents import parse_object
from wayside.api.parameter import Merge, Parameter
from wayside.rules import compile_rule

GUIDE = Path(__file__).parents[2].joinpath("docs", "templates.md").read_text()
BLOCKS = re.findall(r"^```yaml\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)
OBJECTS = [parse_object(each) for block in BLOCKS for each in yaml.safe_load_all(block)]


def instance(*without: str) -> dict[str, Any]:
    objects = [each for each in OBJECTS if each.name not in without and not isinstance(each, EventRule)]
    rendered = render_objects(objects, Policy(), NOW)
    assert rendered.refusals == []
    (found,) = [each for each in rendered.objects if each["kind"] == "ApplicationInstance"]
    parameters: dict[str, Any] = found["spec"]["parameters"]
    return parameters


def test_the_tasks_come_to_what_the_text_says() -> None:
    merged = {"region": "north", "detail": "low", "sources": ["car1", "car2", "car3"], "uplink": 100, "rateHz": 2}
    assert instance() == merged
    assert instance("thin-network") == {**merged, "rateHz": 20}


def test_the_rule_reconfigures_and_suspends() -> None:
    (rule,) = [each for each in OBJECTS if isinstance(each, EventRule)]
    compiled = compile_rule(rule, a_detector(a_stream("uplink")))
    assert [each.operation for each in compiled.deploys] == ["Reconfigure", "Suspend"]


def test_the_tables_name_all_strategies_and_fields() -> None:
    assert set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| `[A-Z].*? \|", GUIDE, re.MULTILINE)))) >= set(Merge)
    described = set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| `[a-z].*? \|", GUIDE, re.MULTILINE))))
    assert described == set(Parameter.model_fields) - {"description"}
