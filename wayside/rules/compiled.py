"""A rule as the engine evaluates it: expressions compiled, durations in nanoseconds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from wayside.api.eventrule import Aggregate
from wayside.api.model import ModelImage, ModelPoints, ModelSource
from wayside.api.operation import Operation
from wayside.expressions import CompiledTemplate, Expression
from wayside.geo.geometry import Shape
from wayside.rules.parameters import NO_PARAMETERS, Parameters


@dataclass(frozen=True, slots=True)
class CompiledSignal:
    """The definition of one signal."""

    name: str
    stream: str
    """A stream of the Detector, or the result of `episode_stream` for `rule`."""
    aggregate: Aggregate
    value: Expression | None
    where: Expression | None
    over_ns: int | None
    parameters: Parameters = NO_PARAMETERS
    """The `parameters` of value and where, by client."""
    rule: str | None = None
    """The rule whose episode starts or ends are the samples; None where they come from a stream."""
    element: CompiledElement | None = None
    """The element that it is computed for, where value or where read it."""
    quantile: float | None = None
    """Of the aggregate Quantile, in [0, 1]."""
    client: str | None = None
    """Whose samples these are, for every subject; None: the subject's own."""

    @property
    def place(self) -> str:
        """Under this its samples' values are kept: names have no `~`."""
        return self.name if self.element is None else f"{self.name}~{self.element.name}"


@dataclass(frozen=True, slots=True)
class CompiledDerived:
    """A signal over the values that an expression had at the evaluations of a subject; times in nanoseconds."""

    name: str
    of: Expression | None
    """None: it is the age of the open episode."""
    aggregate: Aggregate
    over_ns: int
    lag_ns: int
    quantile: float | None = None
    episode: bool = False
    """Whether it is a statistic of the open episode; it has no window then."""

    @property
    def keeps(self) -> bool:
        """Whether it looks at earlier evaluations."""
        return not self.episode and (self.lag_ns > 0 or self.aggregate is not Aggregate.LAST)


def episode_stream(rule: str, *, ends: bool = False) -> str:
    """The name of a rule's episode starts, or ends, in place of a stream name; no stream can have such a name."""
    return f"rule/{rule}/ends" if ends else f"rule/{rule}"


@dataclass(frozen=True, slots=True)
class CompiledPlugin:
    """A signal that a plugin computes."""

    name: str
    plugin: str
    parameters: Mapping[str, Any] = field(hash=False)
    """As written; the plugin's own model validates them."""


@dataclass(frozen=True, slots=True)
class CompiledPosition:
    """The definition of a client's position."""

    stream: str
    axes: Mapping[str, Expression]
    """x and y, perhaps z, in metres; or latitude and longitude, in degrees (WGS 84)."""
    parameters: Parameters = NO_PARAMETERS
    max_age_ns: int | None = None
    """Of older samples the position is unknown; None: as long as the stream is not stale."""

    @property
    def geographic(self) -> bool:
        """Whether it is on the Earth, else in a flat frame."""
        return "latitude" in self.axes


@dataclass(frozen=True, slots=True)
class ClientSubject:
    """The rule is about each client."""

    where: Expression | None


@dataclass(frozen=True, slots=True)
class PairSubject:
    """The rule is about each pair of clients at most `within` metres apart."""

    position: CompiledPosition
    within: float
    where: Expression | None
    a: Expression | None = None
    b: Expression | None = None
    maximum: int = 10_000
    """The maximum number of pairs in reach per evaluation."""
    closing_speed: bool = False
    """Whether any expression uses it."""

    @property
    def ordered(self) -> bool:
        """Whether (car1, car2) and (car2, car1) are two subjects."""
        return self.a is not None or self.b is not None


@dataclass(frozen=True, slots=True)
class FleetSubject:
    """The rule is about all members together."""

    members: Expression


CompiledSubject = ClientSubject | PairSubject | FleetSubject


@dataclass(frozen=True, slots=True)
class CompiledElement:
    """One of the elements that the rule is evaluated for; a rule without `each` has one without a name."""

    name: str | None = None
    variables: Mapping[str, Any] = field(default_factory=dict)
    """The element's map under its variable's name."""
    signals: tuple[CompiledSignal, ...] = ()
    """The signals that are computed for this element: those that read it."""


@dataclass(frozen=True, slots=True)
class CompiledDeploy:
    """A deploy action; its parameters are rendered over the rule's variables."""

    action: str
    template: str
    priority: int
    source: str
    """The parameters as written, in canonical JSON."""
    parameters: CompiledTemplate = field(compare=False)
    follow: bool = False
    """Whether the parameters are evaluated again at each evaluation."""
    each_parameter: Mapping[str, CompiledTemplate] = field(default_factory=dict, compare=False)
    """The parameters one by one, where they follow."""
    operation: Operation = Operation.DEPLOY

    @property
    def fixed(self) -> tuple[str, Operation, int]:
        """The fields that never change while its tasks are live."""
        return self.template, self.operation, self.priority


@dataclass(frozen=True, slots=True)
class CompiledWindow:
    """The samples that an action gets of an episode."""

    streams: frozenset[str]
    latched: frozenset[str]
    """Streams whose last samples are included, however old they are."""
    shared: frozenset[str]
    """The latched streams that belong to one client named by the Detector: they are included for every client."""
    clients: frozenset[str] | None
    """Beside the episode's own; None: those of all clients."""
    before_ns: int
    """Before the onset."""
    after_ns: int
    """After the end."""


@dataclass(frozen=True, slots=True)
class CompiledAction:
    """An action other than deploy."""

    name: str
    templates: Mapping[str, CompiledTemplate] = field(compare=False)
    """The values that are rendered over the rule's variables at the start of each episode."""
    window: CompiledWindow | None
    source: str
    """The action as written, in canonical JSON: another action where this differs."""


class ModelRunner(Protocol):
    """A model that is ready to run. Deterministic: the same inputs give the same outputs."""

    @property
    def sha256(self) -> str:
        """Of the model's file."""

    def tensor(self, name: str, payload: bytes) -> Any:
        """The bytes of a camera's or lidar's message as a tensor for that input; raises the engine's DecodeError."""

    def run(self, rows: Sequence[Mapping[str, Any]]) -> list[Any]:
        """The signal's value for each row of inputs by name. Raises ValueError where the model fails."""


@dataclass(frozen=True, slots=True)
class CompiledModel:
    """A signal that a model computes."""

    name: str
    index: int
    """Its place among the rule's signals."""
    source: ModelSource
    windows: Mapping[tuple[str, str], CompiledSignal] = field(compare=False)
    """By the name of the input and of the signal: where its samples are found."""
    runner: ModelRunner | None = field(default=None, compare=False)
    """None until the model's file is bound to the rule."""

    @property
    def sensors(self) -> tuple[ModelImage | ModelPoints, ...]:
        """The cameras and lidars that it looks at."""
        return tuple(source for each in self.source.inputs if (source := each.image or each.points) is not None)


@dataclass(frozen=True, slots=True)
class CompiledRule:
    """A rule, ready to be evaluated."""

    name: str
    subject: CompiledSubject
    signals: tuple[CompiledSignal, ...]
    """All of them. Those that read the element of `each` are computed for each element: see `elements`."""
    plugins: tuple[CompiledPlugin, ...]
    when: Expression
    until: Expression | None
    every_ns: int | None
    """None: it is evaluated with samples or on demand."""
    for_ns: int
    cooldown_ns: int
    unknown_timeout_ns: int
    enabled: bool
    dry_run: bool
    deploys: tuple[CompiledDeploy, ...]
    actions: tuple[CompiledAction, ...]
    classification: dict[str, Any] | None
    digest: str
    """Of the fields that decide which episodes there are: open episodes end when it changes."""
    elements: tuple[CompiledElement, ...] = (CompiledElement(),)
    parameters: Parameters = NO_PARAMETERS
    models: tuple[CompiledModel, ...] = ()
    """The signals that models compute."""
    places: tuple[Shape, ...] = ()
    """The places that its expressions name."""
    derived: tuple[CompiledDerived, ...] = ()
    """The signals over what conditions see, each after those that it reads."""
    has_margin: bool = False
    """Whether one of these is the margin of `when`."""
    on_sample: str | None = None
    """The stream with whose samples it is evaluated."""
    on_demand: bool = False
    priority: int = 0
    maximum_per_hour: int | None = None
    """The maximum number of episodes per client and hour; None: no limit."""

    @property
    def has_actions(self) -> bool:
        """Whether an episode has any consequence in addition to its events, so that its variables may be rendered."""
        return bool(self.deploys or self.actions)

    @property
    def common_signals(self) -> tuple[CompiledSignal, ...]:
        """The signals that are the same for all elements."""
        own = {signal.name for signal in self.elements[0].signals}
        return tuple(signal for signal in self.signals if signal.name not in own)

    @property
    def linked(self) -> frozenset[str]:
        """The streams of whose samples it reads the one before."""
        signals = [(signal.stream, each) for signal in self.signals for each in (signal.value, signal.where)]
        position = self.subject.position if isinstance(self.subject, PairSubject) else None
        axes = [] if position is None else [(position.stream, each) for each in position.axes.values()]
        return frozenset(stream for stream, each in (*signals, *axes) if each is not None and "before" in each.names)

    @property
    def streams(self) -> frozenset[str]:
        """The streams that it looks at."""
        position = {self.subject.position.stream} if isinstance(self.subject, PairSubject) else set()
        seen = (source.stream for model in self.models for source in model.sensors)
        return frozenset({*position, *seen, *(signal.stream for signal in self.signals)})


@dataclass(frozen=True, slots=True)
class CompiledStream:
    """The expressions of a stream for the sender's time and the client, if the Detector has them."""

    name: str
    stamp: Expression | None
    client: CompiledTemplate | None = None
    items: Expression | None = None
