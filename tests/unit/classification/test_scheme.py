"""The scheme: each dimension and value has words and a definition, the guide has them all, a list has each once."""

from __future__ import annotations

import pytest
import yaml
from pydantic import ValidationError

from tests.guides import guide, yaml_blocks
from wayside.api.classification import SCHEME, Classification

GUIDE = guide("classification")

WORDS = {
    "Overarching Purpose": "safety, efficiency, user satisfaction",
    "Type of Participants": "vehicle, VRU, road infrastructure, remote infrastructure",
    "Number of Participants": "one, two, multiple",
    "Data Source Entity": "event source entity, external",
    "Event Detection Entity": "event source entity, data source entity, external",
    "Acting Entity": "event detection entity, external",
    "Affected Entity": "acting entity, external",
    "Scope of Impact": "participant, environment, beyond environment",
    "Observation Period": "immediate, short-term, long-term",
    "Time Sensitivity": "immediate, short-term, long-term",
    "Incidence": "frequent, common, rare, unexpected",
    "Detection Algorithm": "rule-based, learning-based",
    "Type of Action": "data collection, reconfiguration, deployment, notification, other",
}
"""Table 1, as the paper writes it."""


def test_the_words_are_those_of_table_1_in_its_order() -> None:
    assert [(d.words, ", ".join(value.words for value in d.values)) for d in SCHEME] == list(WORDS.items())


def test_the_model_has_the_dimensions_of_the_scheme_in_its_order() -> None:
    fields = Classification.model_json_schema()["properties"]
    assert list(fields) == [dimension.name for dimension in SCHEME]
    every = {dimension.name: [value.value for value in dimension.values] for dimension in SCHEME}
    assert Classification.model_validate(every).to_json() == every
    for dimension in SCHEME:
        assert all(
            f"{value.value}: {value.definition}" in fields[dimension.name]["description"] for value in dimension.values
        )


def test_the_guides_table_is_the_scheme() -> None:
    section = GUIDE.split("## The scheme", 1)[1].split("\n## ", 1)[0]
    rows = [line for line in section.splitlines() if line.startswith("| ")][1:]
    wanted = []
    for dimension in SCHEME:
        wanted.append(f"| `{dimension.name}` | | {dimension.definition} |")
        wanted += [f"| | `{value.value}` | {value.definition} |" for value in dimension.values]
    assert rows == wanted


def test_the_guides_example_is_a_classification() -> None:
    (example,) = yaml_blocks(GUIDE)
    given = yaml.safe_load(example)["spec"]["classification"]
    assert Classification.model_validate(given).to_json() == given


def test_a_value_that_is_given_twice_is_refused() -> None:
    with pytest.raises(ValidationError, match="Rare is given twice: give it once"):
        Classification.model_validate({"incidence": ["Rare", "Common", "Rare"]})
