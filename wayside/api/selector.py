"""Kubernetes' label selector."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated

from pydantic import ConfigDict, Field

from wayside.api.base import ATOMIC_LIST, ATOMIC_MAP, Model
from wayside.api.constraints import constraint

LabelKey = Annotated[
    str, Field(min_length=1, max_length=317, pattern=r"^([-a-z0-9.]{1,253}/)?[A-Za-z0-9]([-_.A-Za-z0-9]*[A-Za-z0-9])?$")
]
"""The key of a label, with or without a prefix."""

LabelValue = Annotated[str, Field(max_length=63, pattern=r"^([A-Za-z0-9]([-_.A-Za-z0-9]*[A-Za-z0-9])?)?$")]
"""The value of a label."""


class LabelOperator(StrEnum):
    """The relation of a label to the values of a requirement."""

    IN = "In"
    NOT_IN = "NotIn"
    EXISTS = "Exists"
    DOES_NOT_EXIST = "DoesNotExist"


class LabelRequirement(Model):
    """A requirement on one label."""

    constraints = (
        constraint(
            "(self.operator in ['In', 'NotIn']) == (has(self.values) && self.values.size() > 0)",
            "operators In and NotIn need values; with Exists and DoesNotExist, remove values",
            ".values",
            holds=lambda required: (required.operator in ("In", "NotIn")) == bool(required.values),
        ),
    )

    key: LabelKey
    """The key of the label."""
    operator: LabelOperator
    """In, NotIn: the value is, or is not, one of values; NotIn also matches without the label. Exists, DoesNotExist:
    the label is present, or absent."""
    values: list[LabelValue] = Field(default_factory=list, max_length=64, json_schema_extra=ATOMIC_LIST)
    """The values for operators In and NotIn."""

    def matches(self, labels: Mapping[str, str]) -> bool:
        """Whether the labels meet the requirement."""
        match self.operator:
            case LabelOperator.IN:
                return labels.get(self.key) in self.values
            case LabelOperator.NOT_IN:
                return labels.get(self.key) not in self.values
            case LabelOperator.EXISTS:
                return self.key in labels
            case LabelOperator.DOES_NOT_EXIST:
                return self.key not in labels

    def __str__(self) -> str:
        """In the syntax of kubectl's option --selector."""
        match self.operator:
            case LabelOperator.EXISTS:
                return self.key
            case LabelOperator.DOES_NOT_EXIST:
                return f"!{self.key}"
        relation = "in" if self.operator is LabelOperator.IN else "notin"
        return f"{self.key} {relation} ({', '.join(self.values)})"


class LabelSelector(Model):
    """Selects objects by their labels. An object must meet all requirements; an empty selector selects every object."""

    model_config = ConfigDict(json_schema_extra=ATOMIC_MAP)

    match_labels: dict[LabelKey, LabelValue] = Field(default_factory=dict, max_length=16)
    """The labels that an object must have."""
    match_expressions: list[LabelRequirement] = Field(
        default_factory=list, max_length=16, json_schema_extra=ATOMIC_LIST
    )
    """Further requirements, all of which an object must meet."""

    def matches(self, labels: Mapping[str, str]) -> bool:
        """Whether an object with these labels is selected."""
        return all(labels.get(key) == value for key, value in self.match_labels.items()) and all(
            each.matches(labels) for each in self.match_expressions
        )

    def __str__(self) -> str:
        """In the syntax of kubectl's option --selector; empty if every object is selected."""
        labels = [f"{key}={value}" for key, value in sorted(self.match_labels.items())]
        return ", ".join([*labels, *map(str, self.match_expressions)])
