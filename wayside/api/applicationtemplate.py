"""ApplicationTemplate: how an application is deployed, and how the demands of several tasks become one."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, ClassVar

from pydantic import Field, field_validator, model_validator

from wayside.api.base import (
    Condition,
    Duration,
    Expression,
    Identifier,
    JsonValue,
    Kind,
    Model,
    conditions_field,
    validations,
)


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
    MAX = "Max"
    MIN = "Min"
    HIGHEST_PRIORITY = "HighestPriority"


class Parameter(Model):
    """One input of the template."""

    # That a required parameter has no default is said by the manager: to the CRD's CEL, `default` has no type.
    model_config = validations(
        ("!has(self.merge) || self.merge != 'Union' || self.type == 'array'", "merge Union needs type array"),
        (
            "!has(self.merge) || !(self.merge in ['Max', 'Min']) || self.type in ['number', 'integer']",
            "merge Max and Min need type number or integer",
        ),
        (
            "(!has(self.minimum) && !has(self.maximum)) || self.type in ['number', 'integer']",
            "minimum and maximum need type number or integer",
        ),
        ("!has(self.items) || self.type == 'array'", "items needs type array"),
    )

    type: ParameterType = Field(description="The JSON type.")
    items: ItemType | None = Field(default=None, description="The type of an array's items; any where absent.")
    description: str = Field(default="", max_length=1024, description="What the parameter means, with its unit.")
    required: bool = Field(default=False, description="Whether each task must give it.")
    default: JsonValue = Field(default=None, description="The value where no task gives one.")
    minimum: float | None = Field(default=None, description="The smallest value of a number.")
    maximum: float | None = Field(default=None, description="The largest value of a number.")
    enum: list[JsonValue] | None = Field(
        default=None,
        max_length=64,
        description="The values allowed.",
        json_schema_extra={"x-kubernetes-list-type": "atomic"},
    )
    merge: Merge = Field(
        default=Merge.SAME,
        description="Same: tasks must agree; one that differs is refused, reason Conflict. Union: all items of the "
        "arrays, sorted. Max, Min: of the numbers. HighestPriority: the value of the first task by priority.",
    )

    @model_validator(mode="after")
    def _coherent(self) -> Parameter:
        numeric = self.type in (ParameterType.NUMBER, ParameterType.INTEGER)
        if self.merge is Merge.UNION and self.type is not ParameterType.ARRAY:
            raise ValueError(f"merge Union needs type array, not {self.type}")
        if self.merge in (Merge.MAX, Merge.MIN) and not numeric:
            raise ValueError(f"merge {self.merge} needs type number or integer, not {self.type}")
        if not numeric and (self.minimum is not None or self.maximum is not None):
            raise ValueError(f"minimum and maximum need type number or integer, not {self.type}")
        if self.items is not None and self.type is not ParameterType.ARRAY:
            raise ValueError(f"items needs type array, not {self.type}")
        if self.required and self.default is not None:
            raise ValueError("a required parameter has no default: remove one of required and default")
        if self.default is not None:
            problem = self.problem(self.default)
            if problem:
                raise ValueError(f"default: {problem}")
        return self

    def problem(self, value: JsonValue) -> str | None:
        """Why the value does not fit the parameter, or None if it does."""
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
            return isinstance(value, int | float) and not isinstance(value, bool) and float(value).is_integer()
        case ParameterType.BOOLEAN:
            return isinstance(value, bool)
        case ParameterType.ARRAY:
            return isinstance(value, list)
        case ParameterType.OBJECT:
            return isinstance(value, dict)


class LossPolicy(StrEnum):
    """What becomes of demands whose holder is gone."""

    RELEASE = "Release"
    HOLD = "Hold"


class OnDetectorLoss(Model):
    """What becomes of demands whose holder's Lease lapsed."""

    policy: LossPolicy = Field(
        default=LossPolicy.RELEASE, description="Release: they no longer count. Hold: they count until they end."
    )
    after: Duration = Field(
        default=Duration("30s"), description="With Release: how long after the Lease's own duration they still count."
    )


class Lifecycle(Model):
    """How long instances live."""

    linger: Duration = Field(
        default=Duration("30s"), description="How long an instance stays after its last demand has ended."
    )
    on_detector_loss: OnDetectorLoss = Field(
        default=OnDetectorLoss(), description="What becomes of demands whose holder's Lease lapsed."
    )


Manifest = Annotated[dict[str, Any], Field(json_schema_extra={"x-kubernetes-preserve-unknown-fields": True})]


FileName = Annotated[str, Field(min_length=1, max_length=253, pattern=r"^[-._a-zA-Z0-9]+$")]
"""A file's name, as ConfigMaps allow it."""


class ApplicationTemplateSpec(Model):
    """Parameters, identity and manifests of an application."""

    description: str = Field(default="", max_length=1024, description="What the application does, for people.")
    parameters: dict[Identifier, Parameter] = Field(
        default_factory=dict, max_length=64, description="What tasks can or must say, and how their values merge."
    )
    key: Expression | None = Field(
        default=None,
        description="Tasks with the same key share one instance, e.g. ${parameters.region}. "
        "Without a key the template has one instance. Immutable.",
    )
    lifecycle: Lifecycle = Field(default=Lifecycle(), description="How long instances live.")
    configuration: dict[FileName, JsonValue] = Field(
        default_factory=dict,
        max_length=64,
        description="Files that the running application follows, by name, with ${…} as in manifests. They become a "
        "ConfigMap, ${instance.configMap}, which changes without a rollout. A text is written as it is; a map or a "
        "list as the extension says, .yaml or .json.",
    )
    manifests: list[Manifest] = Field(
        min_length=1,
        max_length=64,
        description="The objects of an instance, with ${…} over parameters and instance (name, key, namespace, and "
        "configMap where there is a configuration). "
        "apiVersion and kind are literal, the namespace is the template's, and with a key every name contains "
        "${instance.name}.",
        json_schema_extra={"x-kubernetes-list-type": "atomic"},
    )

    @field_validator("manifests")
    @classmethod
    def _literal_kinds(cls, manifests: list[dict[str, Any]]) -> list[dict[str, Any]]:
        for index, manifest in enumerate(manifests):
            for field in ("apiVersion", "kind"):
                value = manifest.get(field)
                if not isinstance(value, str) or not value:
                    raise ValueError(
                        f"manifests[{index}].{field}: is missing: every manifest needs apiVersion and kind"
                    )
                if "${" in value:
                    raise ValueError(f"manifests[{index}].{field}: {value!r} must be literal, without ${{…}}")
        return manifests


class ApplicationTemplateStatus(Model):
    """What the application manager says of the template."""

    observed_generation: int = Field(default=0, description="The generation that the status speaks of.")
    instances: int = Field(default=0, description="How many instances there are.")
    conditions: list[Condition] = conditions_field("Accepted: whether the template can be rendered.")


class ApplicationTemplate(Kind):
    """How an application is deployed, and how the demands on it merge."""

    plural: ClassVar[str] = "applicationtemplates"
    short_name: ClassVar[str] = "apptpl"
    name_limit: ClassVar[int] = 40
    printer_columns: ClassVar[list[dict[str, str]]] = [
        {"name": "Key", "type": "string", "jsonPath": ".spec.key"},
        {"name": "Instances", "type": "integer", "jsonPath": ".status.instances"},
        {"name": "Accepted", "type": "string", "jsonPath": '.status.conditions[?(@.type=="Accepted")].status'},
        {
            "name": "Message",
            "type": "string",
            "jsonPath": '.status.conditions[?(@.type=="Accepted")].message',
            "priority": "1",
        },
        {"name": "Age", "type": "date", "jsonPath": ".metadata.creationTimestamp"},
    ]
    object_validations: ClassVar[list[dict[str, str]]] = [
        {
            "rule": "has(self.spec.key) == has(oldSelf.spec.key)"
            " && (!has(self.spec.key) || self.spec.key == oldSelf.spec.key)",
            "message": "spec.key is immutable, also in being there: make a template of another name instead",
        },
    ]

    kind: str = "ApplicationTemplate"
    spec: ApplicationTemplateSpec = Field(description="Parameters, identity and manifests.")
    status: ApplicationTemplateStatus | None = Field(
        default=None, description="What the application manager says of the template."
    )
