"""Parameters of a template: their types, their bounds, and how the values of several tasks merge."""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum

from pydantic import Field, model_validator

from wayside.api.base import ATOMIC_LIST, JsonValue, Model
from wayside.api.constraints import constraint
from wayside.api.freedata import Value


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
"""The types that a merge strategy supports; a strategy that is not listed supports all types."""

_MAKING = (Merge.UNION, Merge.INTERSECTION, Merge.SUM)
"""The merge strategies that can produce a value that no task has."""


class Parameter(Model):
    """One parameter of the template."""

    # The manager validates `default` and the items of `enum`, which have no type for the CRD's CEL.
    constraints = (
        constraint(
            "!has(self.merge) || !(self.merge in ['Union', 'Intersection']) || self.type == 'array'",
            "merge Union and Intersection need type array",
            ".merge",
        ),
        constraint(
            "!has(self.merge) || !(self.merge in ['Max', 'Min', 'Sum']) || self.type in ['number', 'integer']",
            "merge Max, Min and Sum need type number or integer",
            ".merge",
        ),
        constraint(
            "!has(self.merge) || !(self.merge in ['All', 'Any']) || self.type == 'boolean'",
            "merge All and Any need type boolean",
            ".merge",
        ),
        constraint(
            "(!has(self.minimum) && !has(self.maximum)) || self.type in ['number', 'integer']",
            "minimum and maximum need type number or integer",
            ".type",
        ),
        constraint(
            "!has(self.minimum) || !has(self.maximum) || self.minimum <= self.maximum",
            "minimum must not be above maximum",
            ".minimum",
        ),
        constraint("!has(self.items) || self.type == 'array'", "items needs type array", ".items"),
        constraint(
            "!has(self.pattern) || self.type == 'string'"
            " || (self.type == 'array' && has(self.items) && self.items == 'string')",
            "pattern needs type string, or type array with items string",
            ".pattern",
        ),
    )

    type: ParameterType
    """The JSON type of the value; integer is a number without a fraction."""
    items: ItemType | None = None
    """The JSON type of an array's items. Default: any type."""
    description: str = Field(default="", max_length=1024)
    """The meaning of the parameter, with its unit."""
    required: bool = False
    """If true, every task must set the parameter. A required parameter has no default."""
    default: Value = None
    """The value if no task sets the parameter."""
    minimum: float | None = None
    """The minimum of a number. A task with a smaller value is refused."""
    maximum: float | None = None
    """The maximum of a number. A task with a larger value is refused. A larger merged Sum is capped, and the condition
    Capped of the instance reports it."""
    pattern: str | None = Field(default=None, min_length=1, max_length=256)
    """A regular expression (RE2 syntax) for a string, or for each string of an array. It may match anywhere in the
    string; use ^…$ to match the whole string."""
    enum: list[Value] | None = Field(default=None, min_length=1, max_length=64, json_schema_extra=ATOMIC_LIST)
    """The allowed values. Not with merge Union, Intersection or Sum, which can produce other values."""
    merge: Merge = Merge.SAME
    """How the values of several tasks become one. Same: all tasks must have the same value; a task that differs is
    refused with reason Conflict. Union: the items that occur in any array, sorted. Intersection: the items that occur
    in all arrays, sorted. Max, Min, Sum: the maximum, minimum or sum of the numbers. All: true if all booleans are
    true. Any: true if at least one is true. HighestPriority: the value of the task with the highest priority."""

    @model_validator(mode="after")
    def _coherent(self) -> Parameter:
        for problem in self._incoherences():
            raise ValueError(problem)
        return self

    def _incoherences(self) -> Iterator[str]:
        fitting = _FITTING.get(self.merge, tuple(ParameterType))
        if self.type not in fitting:
            yield f"merge {self.merge} needs type {' or '.join(fitting)}; got {self.type}"
        if self.type not in _NUMERIC and (self.minimum is not None or self.maximum is not None):
            yield f"minimum and maximum need type number or integer; got {self.type}"
        if self.minimum is not None and self.maximum is not None and self.minimum > self.maximum:
            yield f"minimum must not be above maximum {self.maximum:g}; got {self.minimum:g}"
        if self.items is not None and self.type is not ParameterType.ARRAY:
            yield f"items needs type array; got {self.type}"
        if self.pattern is not None and self.type is not ParameterType.STRING and self.items is not ItemType.STRING:
            yield f"pattern needs type string, or type array with items string; got {self.type}"
        if self.enum is not None and self.merge in _MAKING:
            yield f"merge {self.merge} can produce values that enum does not list: remove merge or enum"
        for index, value in enumerate(self.enum or ()):
            if not _has_type(value, self.type):
                yield f"enum[{index}]: {value!r} is not of type {self.type}"
        if self.required and self.default is not None:
            yield "a required parameter cannot have a default: remove required or default"
        if self.default is not None:
            problem = self.problem(self.default)
            if problem:
                yield f"default: {problem}"

    def problem(self, value: JsonValue) -> str | None:
        """Why the value does not fit the parameter, or None if it does. Does not check `pattern`."""
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
            return f"{value!r} is not one of {', '.join(map(repr, self.enum))}"
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
