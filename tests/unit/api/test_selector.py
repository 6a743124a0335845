"""Selectors match labels as Kubernetes' own do."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from wayside.api.selector import LabelSelector

NORTH = {"site": "north", "role": "car"}


@pytest.mark.parametrize(
    ("selector", "text", "matches"),
    [
        ({}, "", True),
        ({"matchLabels": {"site": "north"}}, "site=north", True),
        ({"matchLabels": {"site": "north", "role": "tram"}}, "role=tram, site=north", False),
        ({"matchExpressions": [{"key": "site", "operator": "In", "values": ["a", "north"]}]},
         "site in (a, north)", True),
        ({"matchExpressions": [{"key": "lane", "operator": "In", "values": ["1"]}]}, "lane in (1)", False),
        ({"matchExpressions": [{"key": "site", "operator": "NotIn", "values": ["north"]}]},
         "site notin (north)", False),
        ({"matchExpressions": [{"key": "lane", "operator": "NotIn", "values": ["1"]}]}, "lane notin (1)", True),
        ({"matchExpressions": [{"key": "a.b/site", "operator": "Exists"}]}, "a.b/site", False),
        ({"matchExpressions": [{"key": "site", "operator": "DoesNotExist"}]}, "!site", False),
        (
            {"matchLabels": {"site": "north"}, "matchExpressions": [{"key": "lane", "operator": "DoesNotExist"}]},
            "site=north, !lane",
            True,
        ),
    ],
)  # fmt: skip
def test_all_requirements_must_be_met(selector: dict[str, Any], text: str, matches: bool) -> None:
    made = LabelSelector.model_validate(selector)
    assert made.matches(NORTH) is matches
    assert str(made) == text


@pytest.mark.parametrize(
    "requirement",
    [
        {"key": "site", "operator": "In"},
        {"key": "site", "operator": "Exists", "values": ["north"]},
        {"key": "not a key", "operator": "Exists"},
        {"key": "site", "operator": "in", "values": ["north"]},
    ],
)
def test_an_invalid_requirement_is_rejected(requirement: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        LabelSelector.model_validate({"matchExpressions": [requirement]})
