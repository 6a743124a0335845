"""The examples in docs/rules.md work as described: every rule and Detector in it is accepted."""

from __future__ import annotations

import re
from typing import Any

import pytest
import yaml

from tests.driving import a_detector, a_rule, a_stream
from tests.guides import guide, yaml_blocks
from wayside.api.eventrule import Aggregate
from wayside.expressions import UNKNOWN, CelType, Environment
from wayside.rules import CompiledRule, compile_rule

GUIDE = guide("rules")
STREAMS = ("pose", "speed", "camera-objects", "lidar-objects", "odometry", "scan", "image", "can")
DETECTOR = a_detector(*({**a_stream(name), "key": f"v/${{client:*}}/{name}/${{sensor:*}}"} for name in STREAMS))
MINE = ("Signals", "Parameters", "Functions")


def examples() -> list[tuple[str, dict[str, Any]]]:
    """The YAML blocks of the sections on signals, parameters and functions."""
    sections = re.split(r"^## ", GUIDE, flags=re.MULTILINE)
    return [
        (title, yaml.safe_load(block))
        for section in sections
        if (title := section.partition("\n")[0]) in MINE
        for block in yaml_blocks(section)
    ]


def accepted(example: dict[str, Any]) -> CompiledRule | None:
    """The rule of the example, compiled; a fragment of one is made whole."""
    spec = example.get("spec", example)
    if example.get("kind") == "Detector":
        assert a_detector(a_stream("pose"), **spec).spec.clients
        return None
    name = example.get("metadata", {}).get("name", "r")
    return compile_rule(a_rule(name, **{"when": "true", **spec}), DETECTOR)


@pytest.mark.parametrize("example", [each for _, each in examples()], ids=str)
def test_an_example_is_accepted(example: dict[str, Any]) -> None:
    accepted(example)


def test_unknowns_are_as_in_the_table() -> None:
    table = GUIDE.split("with `u` unknown:", 1)[1].split("\n## ", 1)[0]
    rows = re.findall(r"^\| `(.*)` \| (\w+) \|$", table, re.MULTILINE)
    environment = Environment({"u": CelType.DYN, "m": CelType.MAP})
    found = {source: environment.compile(source).evaluate_or_unknown({"m": {"u": None}}) for source, _ in rows}
    wanted: dict[str, object] = {"unknown": UNKNOWN, "true": True, "false": False, "1": 1.0}
    assert found == {source: wanted[text] for source, text in rows}
    assert len(rows) == 10


def test_every_section_has_an_example() -> None:
    assert {title for title, _ in examples()} == set(MINE)


def test_the_example_overrides_the_parameter_of_the_client() -> None:
    (rule,) = [each for title, each in examples() if title == "Parameters" and each["kind"] == "EventRule"]
    (detector,) = [each for title, each in examples() if title == "Parameters" and each["kind"] == "Detector"]
    compiled = compile_rule(
        a_rule("too-fast", **rule["spec"]), a_detector(a_stream("pose"), a_stream("speed"), **detector["spec"])
    )
    assert compiled.parameters.of("truck-1")["maxSpeed"] == 8.3
    assert compiled.parameters.of("car")["maxSpeed"] == 13.9


def test_every_aggregate_is_in_the_table() -> None:
    section = GUIDE.split("### Aggregates", 1)[1].split("\n## ", 1)[0]
    rows = re.findall(r"^\| ([A-Z][A-Za-z, ]+?)(?: \(default\))? \|", section, re.MULTILINE)
    assert {name for row in rows for name in row.split(", ")} == {*Aggregate}
