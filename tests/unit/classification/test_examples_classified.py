"""The examples are classified as the paper classifies their use cases, and no classification contradicts its rule."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from detector.assembly.checking import findings
from detector.commands.catalog.catalog import catalog, read_files
from detector.commands.catalog.views import json_view
from tests.guides import ROOT
from wayside.api.documents import load_documents

EXAMPLES = ROOT / "examples"

DIMENSIONS = (
    "Overarching Purpose",
    "Type of Participants",
    "Number of Participants",
    "Data Source Entity",
    "Event Detection Entity",
    "Acting Entity",
    "Affected Entity",
    "Scope of Impact",
    "Observation Period",
    "Time Sensitivity",
    "Incidence",
    "Detection Algorithm",
    "Type of Action",
)

TABLES = {
    "battery-health": """
        safety, efficiency
        vehicle
        one
        event source entity
        event source entity
        external
        external
        participant
        short-term
        long-term
        rare
        rule-based
        notification
    """,
    "camera-fault": """
        safety
        vehicle
        one
        event source entity
        event source entity
        event detection entity
        acting entity
        participant
        short-term
        immediate
        rare
        rule-based
        reconfiguration
    """,
    "leaving-the-odd": """
        safety
        vehicle
        one
        event source entity
        data source entity
        event detection entity
        acting entity
        participant
        immediate
        short-term
        frequent
        rule-based
        notification
    """,
    "emergency-vehicle": """
        safety, efficiency
        vehicle, remote infrastructure
        multiple
        event source entity
        external
        event detection entity
        external
        participant, environment
        short-term
        short-term
        common
        rule-based
        reconfiguration
    """,
    "shadow-mode": """
        safety
        vehicle
        one
        event source entity
        data source entity
        event detection entity
        acting entity
        participant, beyond environment
        short-term
        short-term
        common
        rule-based, learning-based
        data collection
    """,
    "collective-learning": """
        safety
        vehicle
        multiple
        event source entity
        data source entity
        event detection entity
        acting entity
        participant, beyond environment
        short-term
        short-term
        common
        rule-based, learning-based
        data collection
    """,
}
"""Tables 2 to 7 of the paper, as it writes them, by the folder of the example; the rule has the folder's name."""


def rules_files() -> list[Path]:
    return sorted(EXAMPLES.glob("*/rules.yaml"))


def the_catalog() -> dict[str, Any]:
    document: dict[str, Any] = json.loads(json_view(catalog(read_files(rules_files()).entries)))
    return document


@pytest.mark.parametrize("folder", TABLES)
def test_the_catalog_has_for_an_example_the_values_of_the_papers_table(folder: str) -> None:
    document = the_catalog()
    (index,) = [
        index
        for index, rule in enumerate(document["rules"])
        if rule["name"] == folder and Path(rule["place"]).parent.name == folder
    ]
    found = {
        dimension["words"]: {value["words"]: index in value["rules"] for value in dimension["values"]}
        for dimension in document["dimensions"]
    }
    lines = [line.strip() for line in TABLES[folder].strip().splitlines()]
    table = dict(zip(DIMENSIONS, lines, strict=True))
    assert list(found) == list(DIMENSIONS)
    for dimension, values in found.items():
        assert {value for value, has in values.items() if has} == set(table[dimension].split(", ")), dimension
        assert set(table[dimension].split(", ")) <= set(values), f"{dimension}: the test's table is not the scheme's"


@pytest.mark.parametrize("file", rules_files(), ids=lambda file: file.parent.name)
def test_no_classification_contradicts_its_rule(file: Path) -> None:
    found = findings(load_documents([file.parent]))
    # Packages that an example brings along are not installed here; all else is compiled.
    assert [str(each) for each in found.problems if " is installed" not in each.message] == []
    assert [each.as_warning() for each in found.warnings] == []
