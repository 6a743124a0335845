"""EventRule: the definition of an event (scope, signals, when, until, for), and its actions."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, ClassVar

from pydantic import Field, model_validator

from wayside.api.actions.action import ActionSpec
from wayside.api.base import (
    ATOMIC_LIST,
    ClientName,
    Conditions,
    Count,
    Duration,
    Expression,
    Identifier,
    Kind,
    Model,
    ObjectName,
    PositiveDuration,
    WindowLength,
    map_list,
)
from wayside.api.classification import Classification
from wayside.api.constraints import checked, constraint, unique
from wayside.api.freedata import Constants
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
    QUANTILE = "Quantile"
    SLOPE = "Slope"
    ALL = "All"
    ANY = "Any"
    DISTINCT = "Distinct"
    AGE = "Age"
    ACTIVE = "Active"
    MIN_TIME = "MinTime"
    MAX_TIME = "MaxTime"


class Samples(StrEnum):
    """Whether the samples are the starts or the ends of another rule's episodes."""

    STARTS = "Starts"
    ENDS = "Ends"


OF_A_SAMPLE = frozenset({Aggregate.LAST, Aggregate.FIRST, Aggregate.PREVIOUS})
"""The aggregates whose result is the value of one sample."""

WITHOUT_VALUE = frozenset({Aggregate.COUNT, Aggregate.AGE, Aggregate.ACTIVE})
"""The aggregates that use no value."""

WINDOWED = frozenset(Aggregate) - OF_A_SAMPLE - {Aggregate.AGE, Aggregate.ACTIVE}
"""The aggregates that need `over`."""

OF_AN_EPISODE = frozenset(
    {
        Aggregate.LAST, Aggregate.FIRST, Aggregate.MIN, Aggregate.MAX, Aggregate.MIN_TIME, Aggregate.MAX_TIME,
        Aggregate.MEAN, Aggregate.SUM, Aggregate.COUNT, Aggregate.ALL, Aggregate.ANY, Aggregate.AGE,
    }
)  # fmt: skip
"""The aggregates over an open episode. Their state is a few numbers, however long the episode lasts."""

_SOURCE = "give exactly one of stream, ruleName, model, plugin and of (none for aggregate Age with over: Episode)"
_OF = "a signal with of cannot have value, where, or the aggregates Age and Active: remove them"
_LAG = "lag needs a signal with of, and is not valid with over: Episode"
_EPISODE = (
    f"over: Episode needs one of the aggregates {', '.join(sorted(OF_AN_EPISODE))}, and of (except with Age, which "
    "cannot have of)"
)
_QUANTILE = "aggregate Quantile needs quantile, e.g. quantile: 0.95; with any other aggregate, remove quantile"
_CLIENT = "client is valid only with stream or ruleName: remove it"
_ENDS = "samples: Ends needs a signal with ruleName and an aggregate other than Active"


class Signal(Model):
    """A value computed from samples, from another rule's episodes, from other signals, by a model, or by a plugin."""

    constraints = (
        constraint(
            "self.aggregate in ['Last', 'First', 'Previous', 'Age', 'Active'] || has(self.over)",
            "every aggregate except Last, First, Previous, Age and Active needs a window: give over, e.g. over: 5s",
            ".over",
            "Required",
        ),
        constraint(
            "has(self.model) || has(self.plugin) || has(self.of) || "
            "(self.aggregate in ['Count', 'Age', 'Active']) != has(self.value)",
            "give value, e.g. value: msg.speed, except with the aggregates Count, Age and Active, which use no value",
            ".value",
        ),
        constraint(
            "self.aggregate != 'Active' || (has(self.ruleName) && !has(self.over) && !has(self.where))",
            "aggregate Active needs a signal with ruleName, without over and where",
            ".aggregate",
        ),
        constraint(
            "[has(self.stream), has(self.ruleName), has(self.model), has(self.plugin), has(self.of)]"
            ".filter(given, given).size() == "
            "(self.aggregate == 'Age' && has(self.over) && self.over == 'Episode' ? 0 : 1)",
            _SOURCE,
        ),
        constraint(
            "!has(self.of) || !(has(self.value) || has(self.where) || self.aggregate in ['Age', 'Active'])", _OF
        ),
        constraint("!has(self.lag) || (has(self.of) && !(has(self.over) && self.over == 'Episode'))", _LAG),
        constraint(
            "!has(self.over) || self.over != 'Episode' || "
            f"(self.aggregate == 'Age') != has(self.of) && self.aggregate in {sorted(map(str, OF_AN_EPISODE))}",
            _EPISODE,
        ),
        constraint("(self.aggregate == 'Quantile') == has(self.quantile)", _QUANTILE),
        constraint("!has(self.client) || has(self.stream) || has(self.ruleName)", _CLIENT, ".client", "Forbidden"),
        constraint("self.samples == 'Starts' || (has(self.ruleName) && self.aggregate != 'Active')", _ENDS, ".samples"),
        constraint(
            "!(has(self.model) || has(self.plugin)) || !(has(self.where) || has(self.over) || has(self.value))",
            "the signal of a model or plugin cannot have value, where or over: remove them",
        ),
    )

    name: Identifier
    """The name of the variable in expressions."""
    stream: ObjectName | None = None
    """The name of a stream of the Detector."""
    rule_name: ObjectName | None = None
    """Instead of a stream: the name of another rule that the Detector selects. The samples are the starts (or ends, see
    samples) of that rule's episodes in which the client is a subject. msg contains episode, subject, subjects,
    onsetTime and startTime (seconds since the epoch), and the values at the start."""
    samples: Samples = Samples.STARTS
    """Only with ruleName. Starts: the samples are the starts of episodes. Ends: the samples are the ends of episodes;
    msg also contains endTime, reason and the values at the end."""
    model: ModelSource | None = None
    """Instead of a stream: an ONNX model over other signals, an image or a point cloud."""
    plugin: SignalPlugin | None = None
    """Instead of a stream: Python code that computes the value for the rule's subject at each evaluation. In a pairs
    scope, the value belongs to the pair: expressions use its name without a or b."""
    of: Expression | None = None
    """Instead of a stream: CEL over the variables of `when`, such as another signal or the distance of a pair. Each
    evaluation of the subject adds the value of the expression as one sample. Without over and lag, the signal is the
    value itself. In a pairs scope, the value belongs to the pair: expressions use its name without a or b. Samples are
    kept as long as over and lag need them; each takes at most 25 bytes."""
    client: ClientName | None = None
    """Only with stream or ruleName: the client whose samples or episodes the signal uses for every subject, e.g. a
    traffic light. The signal is unknown while the detector does not know this client. Default: the subject's own
    client."""
    value: Expression | None = None
    """CEL over msg (the decoded sample), item (its item, if the stream has items), before (the client's previous
    message or item, unless it was already stale), key (the captured chunks), sample (stamp, received, latency, size)
    and parameters. Required, except with the aggregates Count, Age and Active."""
    where: Expression | None = None
    """CEL over msg, key, sample and parameters. Samples for which it is not true are ignored."""
    over: WindowLength | None = None
    """The length of the window: at tick t the window is (t - over, t]. Required, except with the aggregates Last,
    First, Previous, Age and Active. Episode (only with of): the window is the open episode, from its start to its end.
    Such a signal is known only while an episode is open. Events and actions can use it; conditions and other signals
    cannot."""
    lag: PositiveDuration | None = None
    """Only with of: the time between the end of the window and the tick. At tick t the window is (t - lag - over, t -
    lag]."""
    aggregate: Aggregate = Aggregate.LAST
    """How the samples become one value. Last, Previous, First: the newest, the second newest, the oldest value. Min,
    Max, Mean, Sum, StdDev (of the population), Quantile: of numbers. Delta: last - first. Rate: Delta per second.
    Slope: the slope of the least-squares line, per second. All, Any: of booleans. Distinct: the list of distinct
    values. Count: the number of samples. Age: seconds since the last sample was received; with over: Episode, seconds
    since the start of the episode. Active (only with ruleName): whether an episode is open. MinTime, MaxTime: the time
    of the first smallest or largest number, in seconds since the epoch."""

    quantile: float | None = Field(default=None, ge=0, le=1)
    """Only with aggregate Quantile: 0.5 for the median, 0.95 for the 95th percentile. Interpolated linearly between two
    values."""

    @property
    def is_derived(self) -> bool:
        """Whether it belongs to the subject: it is computed from the variables of conditions, or the episode."""
        return self.of is not None or (self.over is not None and self.over.is_episode)

    @model_validator(mode="after")
    def _complete(self) -> Signal:
        episode = self.over is not None and self.over.is_episode
        sources = sum(each is not None for each in (self.stream, self.rule_name, self.model, self.plugin, self.of))
        if sources != (0 if episode and self.aggregate is Aggregate.AGE else 1):
            raise ValueError(_SOURCE)
        if episode and (self.aggregate not in OF_AN_EPISODE or (self.of is None) != (self.aggregate is Aggregate.AGE)):
            raise ValueError(_EPISODE)
        if self.lag is not None and (self.of is None or episode):
            raise ValueError(_LAG)
        if (self.aggregate is Aggregate.QUANTILE) != (self.quantile is not None):
            raise ValueError(_QUANTILE)
        if self.client is not None and self.stream is None and self.rule_name is None:
            raise ValueError(_CLIENT)
        if self.samples is Samples.ENDS and (self.rule_name is None or self.aggregate is Aggregate.ACTIVE):
            raise ValueError(_ENDS)
        if self.model is not None or self.plugin is not None:
            if self.value or self.where or self.over or self.aggregate is not Aggregate.LAST:
                raise ValueError(
                    "the signal of a model or plugin cannot have value, where, over or aggregate: remove them"
                )
            return self
        if self.of is not None and (self.value or self.where or self.aggregate in (Aggregate.AGE, Aggregate.ACTIVE)):
            raise ValueError(_OF)
        if self.aggregate in WINDOWED and self.over is None:
            raise ValueError(f"aggregate {self.aggregate} needs a window: give over, e.g. over: 5s")
        if self.aggregate is Aggregate.ACTIVE and (self.rule_name is None or self.over or self.where):
            raise ValueError("aggregate Active needs a signal with ruleName, without over and where")
        if self.of is None and self.aggregate not in WITHOUT_VALUE and self.value is None:
            raise ValueError(f"aggregate {self.aggregate} needs a value, e.g. value: msg.speed")
        if self.aggregate in WITHOUT_VALUE and self.value is not None:
            raise ValueError(f"aggregate {self.aggregate} uses no value: remove value (to select samples, use where)")
        return self


_DEFAULT_PERIOD = Duration("1s")
"""The default period of a rule."""


class Evaluation(Model):
    """When the rule is evaluated: at most one of every, onSample and onDemand."""

    constraints = (
        constraint(
            "[has(self.every), has(self.onSample), has(self.onDemand)].filter(given, given).size() <= 1",
            "give at most one of every, onSample and onDemand",
            holds=lambda when: (when.every, when.on_sample, when.on_demand).count(None) >= 2,
        ),
    )

    every: Duration | None = Field(
        default=None, json_schema_extra=checked("duration(self) >= duration('10ms')", "must be 10ms or more")
    )
    """The period of evaluation, 10ms or more. The rule is evaluated at whole multiples of it. Default: 1s."""
    on_sample: ObjectName | None = None
    """The stream whose samples trigger the evaluation of the rule, for the subjects of the sample's client. The rule is
    also evaluated whenever a `for`, a cooldown or an unknownTimeout expires."""
    on_demand: bool | None = Field(
        default=None, json_schema_extra=checked("self", "must be true: remove it, or set it to true")
    )
    """If true, the rule is evaluated only on request."""
    priority: int = Field(default=0, ge=-1_000, le=1_000)
    """Under overload, the detector evaluates rules of lower priority less often, the lowest first."""

    @property
    def period_ns(self) -> int | None:
        """The period in nanoseconds; None if the rule has none."""
        if self.on_sample is not None or self.on_demand:
            return None
        return (self.every or _DEFAULT_PERIOD).ns

    @model_validator(mode="after")
    def _consistent(self) -> Evaluation:
        if self.every is not None and self.every.ns < 10_000_000:
            raise ValueError(f"every: must be 10ms or more; got {self.every}")
        if self.on_demand is False:
            raise ValueError("onDemand: must be true; got false: remove it")
        return self


class EventRuleSpec(Model):
    """An event and its actions."""

    constraints = (unique("signals", "actions"),)

    description: str = Field(default="", max_length=1024)
    """A description of the event, for people."""
    classification: Classification | None = None
    """The classification of the use case."""
    enabled: bool = True
    """If false, the rule is loaded and validated, but not evaluated, and its open episodes end."""
    dry_run: bool = False
    """If true, events are published with `dryRun: true` in their data, but no action runs."""
    scope: Scope = Scope(client=ClientScope())
    """The subjects of the rule."""
    each: Each | None = None
    """The elements of the rule. The rule is evaluated once for each element."""
    evaluation: Evaluation = Evaluation()
    """When the rule is evaluated."""
    parameters: Constants = Field(default_factory=dict)
    """Constants for expressions, e.g. parameters.limit: numbers, strings, booleans, and lists and maps of these, such
    as polygons; at most 64 KiB in total. A Detector can override them per client."""
    signals: list[Signal] = Field(default_factory=list, max_length=64, json_schema_extra=map_list("name"))
    """The values that conditions use. In a pairs scope, each client has its own values, e.g. a.speed and b.speed."""
    when: Expression
    """CEL, boolean: the condition that starts an episode."""
    margin: dict[Identifier, Annotated[float, Field(gt=0)]] | None = Field(default=None, max_length=64)
    """Adds a signal named margin to the rule: the distance of `when` from its next change, positive while `when` is
    true and negative while it is false. The margin of a comparison is the distance from its threshold; && takes the
    smaller margin of its two sides, || the larger one, and ! negates. If `when` compares different quantities, give the
    scale of each signal (or of distance, closingSpeed): the difference that counts as a margin of 1. The results of a
    replay list the ten largest margins without an episode."""
    until: Expression | None = None
    """CEL, boolean: the condition that ends an open episode. Default: the negation of `when`."""
    for_: Duration = Field(default=Duration("0s"), alias="for")
    """How long `when` must stay true before an episode starts."""
    cooldown: Duration = Duration("0s")
    """The time after the end of an episode in which its subject cannot have a new onset."""
    max_episodes_per_hour: int | None = Field(default=None, ge=1, le=1_000_000)
    """The maximum number of episodes per client and hour. Further episodes are skipped and counted. Default: no
    limit."""
    unknown_timeout: Duration | None = None
    """How long the condition of an open episode may be unknown. After that, the episode ends with reason Unknown.
    Default: the Detector's clientTimeout."""
    actions: list[ActionSpec] = Field(default_factory=list, max_length=16, json_schema_extra=map_list("name"))
    """The actions of an episode. Without actions, the rule only publishes events."""


class EventRuleStatus(Model):
    """The observed state of the rule."""

    observed_generation: Count = 0
    """The metadata.generation that the status was computed from."""
    detectors: list[Annotated[str, Field(max_length=63)]] = Field(
        default_factory=list, max_length=256, json_schema_extra=ATOMIC_LIST
    )
    """The Detectors that select the rule."""
    selected_by: str = Field(default="", max_length=1024)
    """The names of the Detectors that select the rule, as one text for tables."""
    conditions: Conditions = Field(default_factory=list)
    """Accepted, Ready: the rule can be evaluated. Stalled: the rule is invalid and must be corrected."""


class EventRule(Kind):
    """An event to detect in the data of vehicles and stations, and the actions that follow from it."""

    plural: ClassVar[str] = "eventrules"
    short_name: ClassVar[str] = "er"
    printer_columns: ClassVar[list[dict[str, Any]]] = [
        {"name": "Enabled", "type": "boolean", "jsonPath": ".spec.enabled"},
        {"name": "Ready", "type": "string", "jsonPath": '.status.conditions[?(@.type=="Ready")].status'},
        {"name": "Detectors", "type": "string", "jsonPath": ".status.selectedBy"},
        {"name": "When", "type": "string", "jsonPath": ".spec.when"},
        {"name": "Age", "type": "date", "jsonPath": ".metadata.creationTimestamp"},
        {"name": "Message", "type": "string", "jsonPath": '.status.conditions[?(@.status=="False")].message'},
    ]

    kind: str = "EventRule"
    spec: EventRuleSpec
    """The definition of the event, and its actions."""
    status: EventRuleStatus | None = None
    """The observed state of the rule."""

    def semantics(self) -> dict[str, Any]:
        """The fields that define the rule's episodes. A change of any of them ends open episodes."""
        spec = self.spec.to_json()
        fields = ("scope", "each", "parameters", "signals", "when", "until", "for")
        return {field: spec.get(field) for field in fields} | (
            {} if (m := spec.get("margin")) is None else {"margin": m}
        )
