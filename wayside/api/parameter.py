"""Parameters of a template: what tasks may say, of which type and within which bounds, and how it merges."""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum

from pydantic import Field, model_validator

from wayside.api.base import JsonValue, Model, validations


class ParameterType(StrEnum):
    """The JSON type of a parameter; integer is a number without a fraction."""

    STRING = "string"
    NUMBER = "number"
    INTEGER = "integer"
    BOOLEAN = "boolean"
    ARRAY = "array"
    OBJECT = "object"


class ItemType(StrEnum):
    """The JSON type of an array's items."""

    STRING = "string"
    NUMBER = "number"
    INTEGER = "integer"
    BOOLEAN = "boolean"


class Merge(StrEnum):
    """How the values of several tasks become one."""

    SAME = "Same"
    UNION = "Union"
    INTERSECTION = "Intersection"
    MAX = "Max"
    MIN = "Min"
    SUM = "Sum"
    ALL = "All"
    ANY = "Any"
    HIGHEST_PRIORITY = "HighestPriority"


_NUMERIC = (ParameterType.NUMBER, ParameterType.INTEGER)

_FITTING: dict[Merge, tuple[ParameterType, ...]] = {
    Merge.UNION: (ParameterType.ARRAY,),
    Merge.INTERSECTION: (ParameterType.ARRAY,),
    Merge.MAX: _NUMERIC,
    Merge.MIN: _NUMERIC,
    Merge.SUM: _NUMERIC,
    Merge.ALL: (ParameterType.BOOLEAN,),
    Merge.ANY: (ParameterType.BOOLEAN,),
}
"""The types that a strategy is for; one that is not here is for all."""

_MAKING = (Merge.UNION, Merge.INTERSECTION, Merge.SUM)
"""The strategies whose result may be a value that no task gave."""


class Parameter(Model):
    """One input of the template."""

    # What concerns `default`, and the items of `enum`, is said by the manager: to the CRD's CEL these have no type.
    model_config = validations(
        (
            "!has(self.merge) || !(self.merge in ['Union', 'Intersection']) || self.type == 'array'",
            "merge Union and Intersection need type array",
        ),
        (
            "!has(self.merge) || !(self.merge in ['Max', 'Min', 'Sum']) || self.type in ['number', 'integer']",
            "merge Max, Min and Sum need type number or integer",
        ),
        (
            "!has(self.merge) || !(self.merge in ['All', 'Any']) || self.type == 'boolean'",
            "merge All and Any need type boolean",
        ),
        (
            "(!has(self.minimum) && !has(self.maximum)) || self.type in ['number', 'integer']",
            "minimum and maximum need type number or integer",
        ),
        (
            "!has(self.minimum) || !has(self.maximum) || self.minimum <= self.maximum",
            "minimum is above maximum: no value would fit",
        ),
        ("!has(self.items) || self.type == 'array'", "items needs type array"),
        (
            "!has(self.pattern) || self.type == 'string'"
            " || (self.type == 'array' && has(self.items) && self.items == 'string')",
            "pattern needs type string, or type array with items string",
        ),
    )

    type: ParameterType = Field(description="The JSON type.")
    items: ItemType | None = Field(default=None, description="The type of an array's items; any where absent.")
    description: str = Field(default="", max_length=1024, description="What the parameter means, with its unit.")
    required: bool = Field(default=False, description="Whether each task must give it.")
    default: JsonValue = Field(default=None, description="The value where no task gives one.")
    minimum: float | None = Field(default=None, description="The smallest value of a number.")
    maximum: float | None = Field(
        default=None,
        description="The largest value of a number. A merged Sum is capped at it, and the instance says so.",
    )
    pattern: str | None = Field(
        default=None,
        min_length=1,
        max_length=256,
        description="What a text, or each text of an array, must match (RE2 syntax), anywhere in it: "
        "write ^…$ for the whole.",
    )
    enum: list[JsonValue] | None = Field(
        default=None,
        min_length=1,
        max_length=64,
        description="The values allowed. Not with merge Union, Intersection and Sum, which make values of their own.",
        json_schema_extra={"x-kubernetes-list-type": "atomic"},
    )
    merge: Merge = Field(
        default=Merge.SAME,
        description="Same: tasks must agree; one that differs is refused, reason Conflict. Union, Intersection: the "
        "items that are in any, or in all, of the arrays, sorted. Max, Min, Sum: of the numbers. All, Any: whether "
        "all, or any, of the booleans are true. HighestPriority: the value of the first task by priority.",
    )

    @model_validator(mode="after")
    def _coherent(self) -> Parameter:
        for problem in self._incoherences():
            raise ValueError(problem)
        return self

    def _incoherences(self) -> Iterator[str]:
        fitting = _FITTING.get(self.merge, tuple(ParameterType))
        if self.type not in fitting:
            yield f"merge {self.merge} needs type {' or '.join(fitting)}, not {self.type}"
        if self.type not in _NUMERIC and (self.minimum is not None or self.maximum is not None):
            yield f"minimum and maximum need type number or integer, not {self.type}"
        if self.minimum is not None and self.maximum is not None and self.minimum > self.maximum:
            yield f"minimum {self.minimum:g} is above maximum {self.maximum:g}: no value would fit"
        if self.items is not None and self.type is not ParameterType.ARRAY:
            yield f"items needs type array, not {self.type}"
        if self.pattern is not None and self.type is not ParameterType.STRING and self.items is not ItemType.STRING:
            yield f"pattern needs type string, or type array with items string, not {self.type}"
        if self.enum is not None and self.merge in _MAKING:
            yield f"merge {self.merge} makes values of its own, which enum cannot list: remove one of merge and enum"
        for index, value in enumerate(self.enum or ()):
            if not _has_type(value, self.type):
                yield f"enum: item {index}, {value!r}, is not of type {self.type}"
        if self.required and self.default is not None:
            yield "a required parameter has no default: remove one of required and default"
        if self.default is not None:
            problem = self.problem(self.default)
            if problem:
                yield f"default: {problem}"

    def problem(self, value: JsonValue) -> str | None:
        """Why the value does not fit the parameter, or None if it does. Of `pattern` this says nothing."""
        if not _has_type(value, self.type):
            return f"{value!r} is not of type {self.type}"
        if self.items is not None:
            for index, item in enumerate(value):
                if not _has_type(item, ParameterType(self.items)):
                    return f"item {index}, {item!r}, is not of type {self.items}"
        if self.minimum is not None and value < self.minimum:
            return f"{value!r} is below the minimum of {self.minimum:g}"
        if self.maximum is not None and value > self.maximum:
            return f"{value!r} is above the maximum of {self.maximum:g}"
        if self.enum is not None and value not in self.enum:
            return f"{value!r} is none of {', '.join(map(repr, self.enum))}"
        return None


def _has_type(value: JsonValue, type_: ParameterType) -> bool:
    match type_:
        case ParameterType.STRING:
            return isinstance(value, str)
        case ParameterType.NUMBER:
            return isinstance(value, int | float) and not isinstance(value, bool)
        case ParameterType.INTEGER:
            return (isinstance(value, int) and not isinstance(value, bool)) or (
                isinstance(value, float) and value.is_integer()
            )
        case ParameterType.BOOLEAN:
            return isinstance(value, bool)
        case ParameterType.ARRAY:
            return isinstance(value, list)
        case ParameterType.OBJECT:
            return isinstance(value, dict)
