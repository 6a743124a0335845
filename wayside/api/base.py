"""The common parts of all kinds: strict camelCase models, durations, quantities, names and metadata."""

from __future__ import annotations

import math
import re
from decimal import Decimal
from typing import Annotated, Any, ClassVar, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    field_validator,
    model_validator,
)
from pydantic.alias_generators import to_camel
from pydantic.config import JsonDict
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from wayside.api.constraints import Constraint
from wayside.times import parse_time

GROUP = "wayside.dev"
VERSION = "v1alpha1"
API_VERSION = f"{GROUP}/{VERSION}"

MANAGED_BY_LABEL = "app.kubernetes.io/managed-by"
MANAGED_BY = "wayside"


class Model(BaseModel):
    """Base of every part of a kind: camelCase on the wire, immutable, and a misspelt field is an error.

    The docstring below a field is its description in the CRD.
    """

    model_config = ConfigDict(
        alias_generator=to_camel, validate_by_name=True, validate_by_alias=True, extra="forbid", frozen=True
    )
    constraints: ClassVar[tuple[Constraint, ...]] = ()

    @model_validator(mode="after")
    def _fulfils_constraints(self) -> Self:
        for constraint in self.constraints:
            if (problem := constraint.problem(self)) is not None:
                raise ValueError(problem)
        return self

    def to_json(self) -> dict[str, Any]:
        """The object as it goes to the API server or into a file: camelCase, absent fields left out."""
        return self.model_dump(mode="json", by_alias=True, exclude_none=True)


class _PatternString(str):
    """A string that pydantic checks against a pattern and that keeps its text unchanged."""

    pattern: ClassVar[str]
    expectation: ClassVar[str]
    maximum_length: ClassVar[int] = 20
    rules: ClassVar[tuple[JsonDict, ...]] = ()

    @classmethod
    def parse(cls, text: str) -> Self:
        """The value of the text. Raises ValueError with the text and the expected form."""
        if len(text) > cls.maximum_length or not re.fullmatch(cls.pattern, text):
            raise ValueError(f"must be {cls.expectation}; got {text!r}")
        return cls(text)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: type[Any], handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(
            cls.parse,
            cls._input_schema(),
            serialization=core_schema.plain_serializer_function_ser_schema(str),
        )

    @classmethod
    def _input_schema(cls) -> CoreSchema:
        return core_schema.str_schema(strict=True)

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        rules = {"x-kubernetes-validations": list(cls.rules)} if cls.rules else {}
        return {"type": "string", "pattern": f"^{cls.pattern}$", "maxLength": cls.maximum_length, **rules}


class Duration(_PatternString):
    """A length of time as Go writes it, such as ``500ms``, ``10s`` or ``1h30m``."""

    pattern = r"([0-9]{1,6}(\.[0-9]{1,9})?(h|m)|[0-9]{1,9}(\.[0-9]{1,9})?(s|ms|us|ns))+"
    expectation = "a duration with units, such as 500ms, 10s, 1.5s or 1h30m"
    _UNITS: ClassVar[dict[str, int]] = {
        "ns": 1,
        "us": 10**3,
        "ms": 10**6,
        "s": 10**9,
        "m": 60 * 10**9,
        "h": 3600 * 10**9,
    }

    @property
    def ns(self) -> int:
        """The duration in nanoseconds; fractions of a nanosecond are truncated, as in Go."""
        return sum(int(Decimal(number) * self._UNITS[unit]) for number, unit in re.findall(r"([0-9.]+)([a-z]+)", self))

    @property
    def seconds(self) -> float:
        """The duration in seconds."""
        return self.ns / 1e9


class PositiveDuration(Duration):
    """A length of time that is not zero."""

    expectation = "a duration above zero, with units, such as 500ms, 10s, 1.5s or 1h30m"
    rules = ({"rule": "!self.matches('^[0.hmnsu]*$')", "message": "give a duration above zero, such as 500ms or 10s"},)

    @classmethod
    def parse(cls, text: str) -> Self:
        """As for any duration; raises ValueError for zero as well."""
        parsed = super().parse(text)
        if parsed.ns == 0:
            raise ValueError(f"must be {cls.expectation}; got {text!r}")
        return parsed


class WindowLength(PositiveDuration):
    """The length of a window, or `Episode`: since the start of the open episode."""

    pattern = rf"({PositiveDuration.pattern}|Episode)"
    expectation = "a duration above zero, such as 500ms, 10s, 1.5s or 1h30m, or Episode"

    @classmethod
    def parse(cls, text: str) -> Self:
        """As for any duration above zero, or Episode."""
        return cls(text) if text == "Episode" else super().parse(text)

    @property
    def is_episode(self) -> bool:
        """Whether the window is the open episode, which has no length."""
        return self == "Episode"


class Quantity(_PatternString):
    """An amount in Kubernetes notation, such as ``64Mi``, ``1e9`` or ``250m``; whole numbers need no quotes."""

    pattern = r"([0-9]{1,18}(\.[0-9]{0,9})?|\.[0-9]{1,9})([numkMGTPE]|[KMGTPE]i|[eE][+-]?[0-9]{1,2})?"
    expectation = "a quantity, such as 512Mi, 2G or 1e9"
    minimum: ClassVar[int] = 0
    _UNITS: ClassVar[dict[str, Decimal]] = {
        **{unit: Decimal(10) ** (3 * power) for power, unit in enumerate(("n", "u", "m", "", "k", *"MGTPE"), -3)},
        **{f"{unit}i": Decimal(2) ** (10 * power) for power, unit in enumerate("KMGTPE", 1)},
    }

    @property
    def value(self) -> Decimal:
        """The exact amount."""
        number, unit = re.fullmatch(r"([0-9.]+)(.*)", self).groups()  # type: ignore[union-attr]  # the pattern fits
        return Decimal(number) * (self._UNITS[unit] if unit in self._UNITS else Decimal(10) ** int(unit[1:]))

    @property
    def bytes(self) -> int:
        """The amount as a size in bytes, rounded up, as Kubernetes does."""
        return math.ceil(self.value)

    @classmethod
    def _input_schema(cls) -> CoreSchema:
        return core_schema.no_info_before_validator_function(_whole_number_as_text, core_schema.str_schema(strict=True))

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        described = super().__get_pydantic_json_schema__(schema, handler)
        del described["type"]
        # No CEL rule: Kubernetes 1.31 assumes a string as long as a whole request here, and refuses the rule's cost.
        return {"x-kubernetes-int-or-string": True, "minimum": cls.minimum, **described}


def _whole_number_as_text(given: object) -> object:
    return str(given) if isinstance(given, int) and not isinstance(given, bool) else given


class PositiveQuantity(Quantity):
    """An amount that is not zero."""

    pattern = (
        r"(0*[1-9][0-9]{0,17}(\.[0-9]{0,9})?|0*\.0{0,8}[1-9][0-9]{0,8})([numkMGTPE]|[KMGTPE]i|[eE][+-]?[0-9]{1,2})?"
    )
    expectation = "a quantity above zero, such as 512Mi, 2G or 1e9"
    minimum = 1


Expression = Annotated[str, Field(min_length=1, max_length=2048)]
"""CEL source text."""

LABEL = r"[a-z0-9]([-a-z0-9]*[a-z0-9])?"
"""The pattern of an RFC 1123 label, which has at most 63 characters."""

SUBDOMAIN = rf"{LABEL}(\.{LABEL})*"
"""The pattern of an RFC 1123 subdomain, which has at most 253 characters."""

ObjectName = Annotated[str, Field(min_length=1, max_length=63, pattern=f"^{LABEL}$")]
"""The name of a Wayside object, or of an item of a list. Names of Services and values of labels contain it."""

TemplateName = Annotated[str, Field(min_length=1, max_length=40, pattern=f"^{LABEL}$")]
"""The name of a template. It is shorter, because the names of instances and their objects are derived from it."""

SubdomainName = Annotated[str, Field(min_length=1, max_length=253, pattern=f"^{SUBDOMAIN}$")]
"""The name of an object of another kind, e.g. of a Secret, for which Kubernetes allows dots."""

ClientName = Annotated[str, Field(min_length=1, max_length=63, pattern=r"^[A-Za-z0-9._:-]+$")]
"""The name of a vehicle or station."""

Key = Annotated[str, Field(min_length=1, max_length=512), AfterValidator(lambda key: key.removeprefix("/"))]
"""A Zenoh key expression. The leading slash of a ROS topic is removed."""

Identifier = Annotated[str, Field(min_length=1, max_length=63, pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
"""A name that expressions can use as a variable."""


def _checked_time(text: str) -> str:
    parse_time(text)
    return text


Time = Annotated[
    str,
    Field(
        max_length=40,
        json_schema_extra={"format": "date-time"},
        pattern=r"^[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}(\.[0-9]{1,9})?(Z|[+-][0-9]{2}:[0-9]{2})$",
    ),
    AfterValidator(_checked_time),
]
"""An RFC 3339 time, with up to nanoseconds."""

JsonValue = Any
"""Any JSON value; the schema has `x-kubernetes-preserve-unknown-fields`."""


ATOMIC_LIST: JsonDict = {"x-kubernetes-list-type": "atomic"}
"""The schema of a list that server-side apply replaces as a whole."""
SET_LIST: JsonDict = {"x-kubernetes-list-type": "set"}
"""The schema of a list of unique items. Each field manager owns the items that it applies."""


ATOMIC_MAP: JsonDict = {"x-kubernetes-map-type": "atomic"}
"""Of a field or model: server-side apply replaces the map as a whole."""


def map_list(key: str) -> JsonDict:
    """The schema of a list that server-side apply merges by this field of its items, which is unique."""
    return {"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": [key]}


class Metadata(BaseModel):
    """The part of Kubernetes' ObjectMeta that the programs read; other fields are kept."""

    model_config = ConfigDict(alias_generator=to_camel, validate_by_name=True, validate_by_alias=True, extra="allow")

    name: str = Field(min_length=1, max_length=253)
    namespace: str = "default"
    uid: str = ""
    labels: dict[str, str] = Field(default_factory=dict)
    annotations: dict[str, str] = Field(default_factory=dict)
    generation: int = 0
    resource_version: str = ""
    creation_timestamp: str = ""
    deletion_timestamp: str | None = None


Count = Annotated[int, Field(ge=0)]
"""A number of things, or a generation."""


class Condition(Model):
    """One condition of an object's state, in the standard form of Kubernetes."""

    type: str = Field(max_length=63)
    """The type of the condition, e.g. Ready."""
    status: str = Field(json_schema_extra={"enum": ["True", "False", "Unknown"]})
    """True, False or Unknown."""
    reason: str = Field(max_length=63, pattern=r"^[A-Za-z][A-Za-z0-9]*$")
    """The machine-readable reason for the status, in CamelCase."""
    message: str = Field(default="", max_length=4096)
    """The human-readable explanation of the status."""
    observed_generation: Count = 0
    """The metadata.generation that the condition was computed from."""
    last_transition_time: Time
    """The time of the last change of the status."""


Conditions = Annotated[list[Condition], Field(max_length=16, json_schema_extra=map_list("type"))]
"""A list of conditions, merged by type."""


class Kind(Model):
    """A resource: apiVersion, kind, metadata and (in subclasses) spec and status.

    Unknown fields beside `spec` and `status` are refused like those inside.
    """

    plural: ClassVar[str]
    short_name: ClassVar[str]
    printer_columns: ClassVar[list[dict[str, Any]]] = []
    selectable_fields: ClassVar[list[str]] = []
    name_limit: ClassVar[int] = 63
    object_validations: ClassVar[list[JsonDict]] = []

    api_version: str = API_VERSION
    kind: str
    metadata: Metadata

    @field_validator("metadata")
    @classmethod
    def _is_named_by_a_label(cls, metadata: Metadata) -> Metadata:
        named = len(metadata.name) <= cls.name_limit and re.fullmatch(LABEL, metadata.name)
        if cls is not Kind and not named:  # Kind itself is the base of objects of any kind
            raise ValueError(
                f"name must have at most {cls.name_limit} lower-case letters, digits and -, with a letter or digit at "
                f"both ends; got {metadata.name!r}"
            )
        return metadata

    @property
    def name(self) -> str:
        """The object's name."""
        return self.metadata.name

    @property
    def namespace(self) -> str:
        """The object's namespace."""
        return self.metadata.namespace
