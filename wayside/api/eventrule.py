"""EventRule: what an event is (scope, signals, when, until, for) and what to do about it."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, ClassVar

from pydantic import Field, model_validator

from wayside.api.actions.action import Action
from wayside.api.base import (
    Condition,
    Duration,
    Expression,
    Identifier,
    Kind,
    Model,
    ObjectName,
    PositiveDuration,
    conditions_field,
    validations,
)
from wayside.api.classification import Classification
from wayside.api.constants import Constants
from wayside.api.evaluation import Evaluation
from wayside.api.model import ModelSource
from wayside.api.plugin import SignalPlugin
from wayside.api.scopes import ClientScope, Each, Scope


class Aggregate(StrEnum):
    """How the samples of a window become one value."""

    LAST = "Last"
    FIRST = "First"
    PREVIOUS = "Previous"
    MIN = "Min"
    MAX = "Max"
    MEAN = "Mean"
    SUM = "Sum"
    COUNT = "Count"
    RATE = "Rate"
    DELTA = "Delta"
    STD_DEV = "StdDev"
    ALL = "All"
    ANY = "Any"
    DISTINCT = "Distinct"
    AGE = "Age"
    ACTIVE = "Active"


OF_A_SAMPLE = frozenset({Aggregate.LAST, Aggregate.FIRST, Aggregate.PREVIOUS})
"""The aggregates that are the value of one sample."""

WITHOUT_VALUE = frozenset({Aggregate.COUNT, Aggregate.AGE, Aggregate.ACTIVE})
"""The aggregates that look at no value."""

WINDOWED = frozenset(Aggregate) - OF_A_SAMPLE - {Aggregate.AGE, Aggregate.ACTIVE}
"""The aggregates that need `over`."""


class Signal(Model):
    """A value computed from a stream's samples, from another rule's episodes, by a model, or by a plugin."""

    model_config = validations(
        (
            "self.aggregate in ['Last', 'First', 'Previous', 'Age', 'Active'] || has(self.over)",
            "all aggregates but Last, First, Previous, Age and Active need a window: give over, e.g. over: 5s",
        ),
        (
            "has(self.model) || has(self.plugin) || (self.aggregate in ['Count', 'Age', 'Active']) != has(self.value)",
            "give value, e.g. value: msg.speed; but none for the aggregates Count, Age and Active, "
            "which look at no value",
        ),
        (
            "self.aggregate != 'Active' || (has(self.rule) && !has(self.over) && !has(self.where))",
            "the aggregate Active is for a signal over a rule, and takes neither over nor where",
        ),
        (
            "[has(self.stream), has(self.rule), has(self.model), has(self.plugin)].filter(given, given).size() == 1",
            "give exactly one of stream, rule, model and plugin",
        ),
        (
            "!(has(self.model) || has(self.plugin)) || !(has(self.where) || has(self.over) || has(self.value))",
            "the signal of a model or plugin has no value, where or over: remove them",
        ),
    )

    name: Identifier = Field(description="The variable by which expressions use the signal.")
    stream: ObjectName | None = Field(default=None, description="The stream of the Detector that it is computed from.")
    rule: ObjectName | None = Field(
        default=None,
        description="Instead of a stream, another rule that the Detector selects: the samples are the starts of its "
        "episodes that the client is a subject of. msg has episode, subject, subjects, onsetTime and startTime "
        "(seconds since the epoch), and the values of the start.",
    )
    model: ModelSource | None = Field(
        default=None, description="Instead of a stream, an ONNX model over other signals, an image or a point cloud."
    )
    plugin: SignalPlugin | None = Field(
        default=None,
        description="Instead of a stream, Python code that computes the value for the rule's subject at each "
        "evaluation. In a pairs scope the value is the pair's: expressions use it by its name alone.",
    )
    value: Expression | None = Field(
        default=None,
        description="CEL over msg (the decoded sample), key (the captured chunks), sample (stamp, received, latency, "
        "size) and parameters. Not needed for Count, Age and Active.",
    )
    where: Expression | None = Field(
        default=None, description="CEL over msg, key, sample, parameters: only samples for which it is true count."
    )
    over: PositiveDuration | None = Field(
        default=None,
        description="The window (t - over, t]. Needed by all aggregates but Last, First, Previous, Age and Active.",
    )
    aggregate: Aggregate = Field(
        default=Aggregate.LAST,
        description="How the samples become one value. Last, Previous, First: the newest, the one before, the oldest. "
        "Min, Max, Mean, Sum, StdDev (of the population): of numbers. Delta: last - first; Rate: that per second. "
        "All, Any: of booleans. Distinct: the list of different values. Count: how many samples. Age: seconds since "
        "the last one was received. Active, of a rule: whether an episode is open.",
    )

    @model_validator(mode="after")
    def _complete(self) -> Signal:
        if sum(source is not None for source in (self.stream, self.rule, self.model, self.plugin)) != 1:
            raise ValueError("give exactly one of stream, rule, model and plugin")
        if self.model is not None or self.plugin is not None:
            if self.value or self.where or self.over or self.aggregate is not Aggregate.LAST:
                raise ValueError("the signal of a model or plugin has no value, where, over or aggregate: remove them")
            return self
        if self.aggregate in WINDOWED and self.over is None:
            raise ValueError(f"aggregate {self.aggregate} needs a window: give over, e.g. over: 5s")
        if self.aggregate is Aggregate.ACTIVE and (self.rule is None or self.over or self.where):
            raise ValueError("aggregate Active is for a signal over a rule, and takes neither over nor where")
        if self.aggregate not in WITHOUT_VALUE and self.value is None:
            raise ValueError(f"aggregate {self.aggregate} needs a value, e.g. value: msg.speed")
        if self.aggregate in WITHOUT_VALUE and self.value is not None:
            raise ValueError(f"aggregate {self.aggregate} looks at no value: remove value (where picks samples)")
        return self


class EventRuleSpec(Model):
    """An event and its actions."""

    description: str = Field(default="", max_length=1024, description="What the event is, for people.")
    classification: Classification | None = Field(
        default=None, description="Where the use case stands in the classification scheme."
    )
    enabled: bool = Field(
        default=True, description="false: the rule is loaded and checked, but not evaluated; open episodes end."
    )
    dry_run: bool = Field(
        default=False, description="true: events are published, marked with dryRun, but no action runs."
    )
    scope: Scope = Field(default=Scope(client=ClientScope()), description="Whom the rule is about.")
    each: Each | None = Field(default=None, description="Evaluate the rule once for each of these elements.")
    evaluation: Evaluation = Field(default=Evaluation(), description="When the rule is evaluated.")
    parameters: Constants = Field(
        default_factory=dict,
        description="Constants that the expressions share, as parameters.<name>: numbers, texts, booleans, and lists "
        "and maps of them, such as polygons. A Detector can set others for single clients.",
    )
    signals: list[Signal] = Field(
        default_factory=list,
        max_length=64,
        description="The values that the conditions use. In a pairs scope each client has its own: a.speed, b.speed.",
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["name"]},
    )
    when: Expression = Field(description="CEL, boolean: an episode starts when it holds.")
    until: Expression | None = Field(
        default=None, description="CEL, boolean: an open episode ends when it holds. Default: not `when`."
    )
    for_: Duration = Field(
        default=Duration("0s"), alias="for", description="`when` must hold this long before an episode starts."
    )
    cooldown: Duration = Field(
        default=Duration("0s"), description="After an episode its subject rests this long; no onset falls into it."
    )
    max_episodes_per_hour: int | None = Field(
        default=None,
        ge=1,
        le=1_000_000,
        description="So many episodes of a client may start within an hour; further ones are left out, and counted.",
    )
    unknown_timeout: Duration | None = Field(
        default=None,
        description="An open episode whose condition stays unknown this long ends, reason Unknown. "
        "Default: the Detector's clientTimeout.",
    )
    actions: list[Action] = Field(
        default_factory=list,
        max_length=16,
        description="What to do about it. Without any, the rule only publishes events.",
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["name"]},
    )

    @model_validator(mode="after")
    def _unique_names(self) -> EventRuleSpec:
        for field, names in (("signals", [s.name for s in self.signals]), ("actions", [a.name for a in self.actions])):
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise ValueError(f"{field}: the name {twice[0]!r} is used twice: names must be unique")
        return self


class EventRuleStatus(Model):
    """What the application manager says of the rule."""

    observed_generation: int = Field(default=0, description="The generation that the status speaks of.")
    detectors: list[Annotated[str, Field(max_length=63)]] = Field(
        default_factory=list,
        max_length=256,
        description="The Detectors that select the rule.",
        json_schema_extra={"x-kubernetes-list-type": "atomic"},
    )
    conditions: list[Condition] = conditions_field(
        "Accepted, Ready: whether the rule can be evaluated. Stalled: it has to be corrected."
    )


class EventRule(Kind):
    """An event to detect in the data of vehicles and stations, and what to do about it."""

    plural: ClassVar[str] = "eventrules"
    short_name: ClassVar[str] = "er"
    printer_columns: ClassVar[list[dict[str, str]]] = [
        {"name": "Enabled", "type": "boolean", "jsonPath": ".spec.enabled"},
        {"name": "Accepted", "type": "string", "jsonPath": '.status.conditions[?(@.type=="Accepted")].status'},
        {"name": "Detectors", "type": "string", "jsonPath": ".status.detectors"},
        {"name": "When", "type": "string", "jsonPath": ".spec.when"},
        {"name": "Age", "type": "date", "jsonPath": ".metadata.creationTimestamp"},
        {"name": "Message", "type": "string", "jsonPath": '.status.conditions[?(@.status=="False")].message'},
    ]

    kind: str = "EventRule"
    spec: EventRuleSpec = Field(description="The event and its actions.")
    status: EventRuleStatus | None = Field(default=None, description="What the application manager says of the rule.")

    def semantics(self) -> dict[str, Any]:
        """The fields that decide which episodes there are; another value of any of them ends open episodes."""
        spec = self.spec.to_json()
        return {field: spec.get(field) for field in ("scope", "each", "parameters", "signals", "when", "until", "for")}
