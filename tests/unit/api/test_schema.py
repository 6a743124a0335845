"""The CRDs in crds/ are those of the models, and the classification is the paper's."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
import yaml

from tests.guides import ROOT
from wayside.api.__main__ import crd_files
from wayside.api.base import Condition
from wayside.api.classification import Classification

CRDS = ROOT / "crds"

FILES = crd_files()

TABLE_1 = {
    "overarchingPurpose": {"Safety", "Efficiency", "UserSatisfaction"},
    "typeOfParticipants": {"Vehicle", "VRU", "RoadInfrastructure", "RemoteInfrastructure"},
    "numberOfParticipants": {"One", "Two", "Multiple"},
    "dataSourceEntity": {"EventSourceEntity", "External"},
    "eventDetectionEntity": {"EventSourceEntity", "DataSourceEntity", "External"},
    "actingEntity": {"EventDetectionEntity", "External"},
    "affectedEntity": {"ActingEntity", "External"},
    "scopeOfImpact": {"Participant", "Environment", "BeyondEnvironment"},
    "observationPeriod": {"Immediate", "ShortTerm", "LongTerm"},
    "timeSensitivity": {"Immediate", "ShortTerm", "LongTerm"},
    "incidence": {"Frequent", "Common", "Rare", "Unexpected"},
    "detectionAlgorithm": {"RuleBased", "LearningBased"},
    "typeOfAction": {"DataCollection", "Reconfiguration", "Deployment", "Notification", "Other"},
}


def test_the_crd_files_are_exactly_those_generated_from_the_models() -> None:
    stale = "crds/ is stale: run `python -m wayside.api`"
    assert {file.name for file in CRDS.iterdir()} == set(FILES), stale
    for name, text in FILES.items():
        assert (CRDS / name).read_text(encoding="utf-8") == text, stale


def spec_of(name: str) -> dict[str, Any]:
    crd: dict[str, Any] = yaml.safe_load(FILES[f"wayside.dev_{name}.yaml"])
    return crd["spec"]  # type: ignore[no-any-return]


def schema_of(name: str) -> dict[str, Any]:
    return spec_of(name)["versions"][0]["schema"]["openAPIV3Schema"]  # type: ignore[no-any-return]


def test_the_classification_has_the_papers_13_dimensions_and_39_values() -> None:
    assert len(TABLE_1) == 13
    assert sum(map(len, TABLE_1.values())) == 39
    properties = schema_of("eventrules")["properties"]["spec"]["properties"]["classification"]["properties"]
    assert {dimension: set(schema["items"]["enum"]) for dimension, schema in properties.items()} == TABLE_1
    assert Classification.model_validate(
        {name: sorted(values) for name, values in TABLE_1.items()}
    ).to_json().keys() == (TABLE_1.keys())
    for dimension, schema in properties.items():
        assert schema["type"] == "array"
        assert schema["maxItems"] == len(TABLE_1[dimension])
        assert schema["x-kubernetes-list-type"] == "set"


def nodes(schema: dict[str, Any], path: str) -> Iterator[tuple[str, dict[str, Any]]]:
    yield path, schema
    for name, child in schema.get("properties", {}).items():
        yield from nodes(child, f"{path}.{name}")
    for key in ("items", "additionalProperties"):
        if isinstance(schema.get(key), dict):
            yield from nodes(schema[key], f"{path}[]")


KINDS = [name.removeprefix("wayside.dev_").removesuffix(".yaml") for name in FILES]


@pytest.mark.parametrize("kind", KINDS)
def test_every_field_is_described_and_bounded(kind: str) -> None:
    for part in ("spec", "status"):
        for path, node in nodes(schema_of(kind)["properties"][part], part):
            if not path.endswith("[]"):
                assert node.get("description"), f"{kind} {path} has no description"
            if node.get("type") == "string":
                assert "maxLength" in node or "enum" in node, f"{kind} {path} is unbounded"
            if node.get("type") == "array":
                assert "maxItems" in node, f"{kind} {path} is unbounded"
                assert "x-kubernetes-list-type" in node, f"{kind} {path} does not define how lists merge"
            if "additionalProperties" in node or node.get("x-kubernetes-preserve-unknown-fields"):
                assert "maxProperties" in node, f"{kind} {path} is unbounded"


@pytest.mark.parametrize("kind", KINDS)
def test_the_schema_is_structural(kind: str) -> None:
    for path, node in nodes(schema_of(kind), kind):
        assert not node.keys() & {"$ref", "anyOf", "allOf", "oneOf", "patternProperties", "title", "const"}, path
        typed = node.keys() & {"type", "x-kubernetes-int-or-string", "x-kubernetes-preserve-unknown-fields"}
        assert typed, path
        assert not ("properties" in node and "additionalProperties" in node), path
        assert None not in node.get("default", {}).values() if isinstance(node.get("default"), dict) else True, path


def test_names_of_fields_are_camel_case_and_enums_pascal_case() -> None:
    # Encodings, Zenoh's modes and JSON's types are written as they are elsewhere.
    lower = {
        "cdr",
        "json",
        "uper",
        "cbor",
        "raw",
        "client",
        "peer",
        "router",
        "string",
        "number",
        "integer",
        "boolean",
        "array",
        "object",
    }
    for kind in KINDS:
        for path, node in nodes(schema_of(kind)["properties"]["spec"], "spec"):
            name = path.rsplit(".", 1)[-1].removesuffix("[]")
            assert re.fullmatch(r"[a-z][A-Za-z0-9]*(\[\])*", name), path
            for value in node.get("enum", []):
                assert re.fullmatch(r"[A-Z][A-Za-z0-9]*", value) or value in lower or kind == "applicationtemplates", (
                    path
                )


def test_kinds_have_their_short_names_status_and_selectable_fields() -> None:
    short = {kind: spec_of(kind)["names"]["shortNames"] for kind in KINDS}
    assert short == {
        "eventrules": ["er"],
        "detectors": ["det"],
        "applicationtemplates": ["apptpl"],
        "applicationtasks": ["apptask"],
        "applicationinstances": ["appinst"],
    }
    for kind in KINDS:
        (version,) = spec_of(kind)["versions"]
        assert version["subresources"] == {"status": {}}
        assert spec_of(kind)["names"]["categories"] == ["wayside"]
        assert spec_of(kind)["scope"] == "Namespaced"
    (task,) = spec_of("applicationtasks")["versions"]
    assert {field["jsonPath"] for field in task["selectableFields"]} == {
        ".spec.templateName",
        ".spec.requester.detectorName",
        ".status.instanceName",
    }
    names = {kind: schema_of(kind)["properties"]["metadata"]["properties"]["name"]["maxLength"] for kind in KINDS}
    assert names == dict.fromkeys(KINDS, 63) | {"applicationtemplates": 40}


@pytest.mark.parametrize("kind", KINDS)
def test_a_new_object_is_not_known_to_be_ready(kind: str) -> None:
    """Without a condition, kstatus takes it as current."""
    (condition,) = schema_of(kind)["properties"]["status"]["default"]["conditions"]
    parsed = Condition.model_validate(condition)
    assert (parsed.type, parsed.status, parsed.reason) == ("Ready", "Unknown", "Pending")


@pytest.mark.parametrize("name", sorted(FILES))
def test_no_cel_rule_validates_int_or_string_fields(name: str) -> None:
    """Kubernetes 1.31 takes such text for as long as a request may be, and refuses the CRD for the cost of the rule."""
    nodes = [schema_of(name.removeprefix("wayside.dev_").removesuffix(".yaml"))]
    while nodes:
        node = nodes.pop()
        assert not ("x-kubernetes-int-or-string" in node and "x-kubernetes-validations" in node)
        nodes += [each for each in node.values() if isinstance(each, dict)]
