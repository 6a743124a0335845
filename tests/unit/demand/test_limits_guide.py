"""The guide's template, with more demands than it allows: they are handled as described."""

from __future__ import annotations

from typing import Any

import yaml

from application_manager.core.claims.claims import instance_name
from application_manager.core.demand.demand import demand
from tests.guides import guide, yaml_blocks
from tests.unit.manager_objects import NOW, instance, task
from wayside.api import ApplicationInstance, ApplicationTemplate
from wayside.times import format_seconds


def documents() -> list[Any]:
    return [yaml.safe_load(block) for block in yaml_blocks(guide("limits"))]


def test_the_guides_template_serves_as_many_as_described_in_the_order_described() -> None:
    raw = next(each for each in documents() if each["metadata"]["name"] == "fusion")
    raw["metadata"]["namespace"] = "site"
    tasks = [task(name, {"region": name}, of="fusion", priority=number) for number, name in enumerate("abc")]
    outcome = demand([ApplicationTemplate.model_validate(raw)], tasks, [], {}, NOW)
    assert {each.key for each in outcome.instances.values()} == {"b", "c"}
    assert outcome.verdicts["a"].reason == "LimitReached"
    assert "a priority of 2 or more" in outcome.verdicts["a"].message


def test_the_guides_fallback_serves_with_the_parameters_that_it_has() -> None:
    templates = []
    for raw in documents():
        raw["metadata"]["namespace"] = "site"
        templates.append(ApplicationTemplate.model_validate(raw))
    name = instance_name("fusion-gpu", "north")
    first = instance(name, of="fusion-gpu", key="north", parameters={"region": "north", "model": "small"}).to_json()
    ready = {"type": "Ready", "status": "False", "reason": "NotReady", "lastTransitionTime": format_seconds(NOW - 60)}
    first["status"] = {"conditions": [ready]}
    live = [task("a", {"region": "north", "model": "small"}, of="fusion-gpu")]
    outcome = demand(templates, live, [ApplicationInstance.model_validate(first)], {}, NOW)
    assert outcome.instances[instance_name("fusion", "north")].parameters == {"region": "north"}
    assert outcome.verdicts["a"].reason == "FallenBack"
