"""A rule in the form that the engine evaluates: expressions are compiled, durations are in nanoseconds."""

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
    """A stream of the Detector, or, with `rule`, the result of `episode_stream`."""
    aggregate: Aggregate
    value: Expression | None
    where: Expression | None
    over_ns: int | None
    parameters: Parameters = NO_PARAMETERS
    """The `parameters` for value and where, by client."""
    rule: str | None = None
    """The rule whose episode starts or ends are the samples; None if the samples come from a stream."""
    element: CompiledElement | None = None
    """The element for which it is computed, if value or where reads the element."""
    quantile: float | None = None
    """The quantile of the aggregate Quantile, in [0, 1]."""
    client: str | None = None
    """The client whose samples are used for every subject; None: the subject's own client."""

    @property
    def place(self) -> str:
        """The key under which the values of its samples are kept. Names contain no `~`."""
        return self.name if self.element is None else f"{self.name}~{self.element.name}"


@dataclass(frozen=True, slots=True)
class CompiledDerived:
    """A signal over the values of an expression at the evaluations of a subject. Times are in nanoseconds."""

    name: str
    of: Expression | None
    """None: the signal is the age of the open episode."""
    aggregate: Aggregate
    over_ns: int
    lag_ns: int
    quantile: float | None = None
    episode: bool = False
    """Whether it is a statistic of the open episode, without a window."""

    @property
    def needs_history(self) -> bool:
        """Whether it needs values of earlier evaluations."""
        return not self.episode and (self.lag_ns > 0 or self.aggregate is not Aggregate.LAST)


def episode_stream(rule: str, *, ends: bool = False) -> str:
    """The name of a rule's episode starts or ends, used like a stream name. No stream can have such a name."""
    return f"rule/{rule}/ends" if ends else f"rule/{rule}"


@dataclass(frozen=True, slots=True)
class CompiledPlugin:
    """A signal that a plugin computes."""

    name: str
    plugin: str
    parameters: Mapping[str, Any] = field(hash=False)
    """The parameters as written. The plugin's own model validates them."""


@dataclass(frozen=True, slots=True)
class CompiledPosition:
    """The definition of a client's position."""

    stream: str
    axes: Mapping[str, Expression]
    """x, y and optionally z, in metres; or latitude and longitude, in degrees (WGS 84)."""
    parameters: Parameters = NO_PARAMETERS
    max_age_ns: int | None = None
    """The position is unknown if the newest sample is older; None: no limit, while the stream is not stale."""

    @property
    def geographic(self) -> bool:
        """Whether the position is in degrees on the Earth; otherwise in metres."""
        return "latitude" in self.axes


@dataclass(frozen=True, slots=True)
class ClientSubject:
    """Each client is a subject."""

    where: Expression | None


@dataclass(frozen=True, slots=True)
class PairSubject:
    """Each pair of clients at most `within` metres apart is a subject."""

    position: CompiledPosition
    within: float
    where: Expression | None
    a: Expression | None = None
    b: Expression | None = None
    maximum: int = 10_000
    """The maximum number of pairs in reach per evaluation."""
    closing_speed: bool = False
    """Whether any expression uses `closingSpeed`."""

    @property
    def ordered(self) -> bool:
        """Whether (car1, car2) and (car2, car1) are two subjects."""
        return self.a is not None or self.b is not None


@dataclass(frozen=True, slots=True)
class FleetSubject:
    """All members together are the subject."""

    members: Expression


CompiledSubject = ClientSubject | PairSubject | FleetSubject


@dataclass(frozen=True, slots=True)
class CompiledElement:
    """An element for which the rule is evaluated. A rule without `each` has one element without a name."""

    name: str | None = None
    variables: Mapping[str, Any] = field(default_factory=dict)
    """The variable of the element, with its map."""
    signals: tuple[CompiledSignal, ...] = ()
    """The signals that read the element, and are computed for it."""


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
    """With `follow`, each parameter by name."""
    operation: Operation = Operation.DEPLOY

    @property
    def fixed(self) -> tuple[str, Operation, int]:
        """The fields that never change while its tasks are live."""
        return self.template, self.operation, self.priority


@dataclass(frozen=True, slots=True)
class CompiledWindow:
    """The samples of an episode that an action receives."""

    streams: frozenset[str]
    latched: frozenset[str]
    """Streams whose last samples are included at any age."""
    shared: frozenset[str]
    """The latched streams that belong to one client named by the Detector: they are included for every client."""
    clients: frozenset[str] | None
    """The clients in addition to those of the episode; None: all clients."""
    before_ns: int
    """The time before the onset."""
    after_ns: int
    """The time after the end."""


@dataclass(frozen=True, slots=True)
class CompiledAction:
    """An action other than deploy."""

    name: str
    templates: Mapping[str, CompiledTemplate] = field(compare=False)
    """The values that are rendered over the rule's variables at the start of each episode."""
    window: CompiledWindow | None
    source: str
    """The action as written, in canonical JSON. A different text is a different action."""


class ModelRunner(Protocol):
    """A model that is ready to run. Deterministic: the same inputs give the same outputs."""

    @property
    def sha256(self) -> str:
        """The SHA-256 digest of the model's file."""

    def tensor(self, name: str, payload: bytes) -> Any:
        """The message of a camera or lidar as a tensor for that input. Raises the engine's DecodeError."""

    def run(self, rows: Sequence[Mapping[str, Any]]) -> list[Any]:
        """The signal's value for each row of inputs by name. Raises ValueError if the model fails."""


@dataclass(frozen=True, slots=True)
class CompiledModel:
    """A signal that a model computes."""

    name: str
    index: int
    """The index of the signal in the rule."""
    source: ModelSource
    windows: Mapping[tuple[str, str], CompiledSignal] = field(compare=False)
    """The signals of windows, with their samples, by the names of the input and of the signal."""
    runner: ModelRunner | None = field(default=None, compare=False)
    """None until the model's file is bound to the rule."""

    @property
    def sensors(self) -> tuple[ModelImage | ModelPoints, ...]:
        """The cameras and lidars among its inputs."""
        return tuple(source for each in self.source.inputs if (source := each.image or each.points) is not None)


@dataclass(frozen=True, slots=True)
class CompiledRule:
    """A rule, ready to be evaluated."""

    name: str
    subject: CompiledSubject
    signals: tuple[CompiledSignal, ...]
    """All signals. Those that read the element of `each` are computed for each element: see `elements`."""
    plugins: tuple[CompiledPlugin, ...]
    when: Expression
    until: Expression | None
    every_ns: int | None
    """None: the rule is evaluated at samples or on demand."""
    for_ns: int
    cooldown_ns: int
    unknown_timeout_ns: int
    enabled: bool
    dry_run: bool
    deploys: tuple[CompiledDeploy, ...]
    actions: tuple[CompiledAction, ...]
    classification: dict[str, Any] | None
    digest: str
    """The digest of the fields that define the rule's episodes: open episodes end when it changes."""
    elements: tuple[CompiledElement, ...] = (CompiledElement(),)
    parameters: Parameters = NO_PARAMETERS
    models: tuple[CompiledModel, ...] = ()
    """The signals that models compute."""
    places: tuple[Shape, ...] = ()
    """The places that its expressions name."""
    derived: tuple[CompiledDerived, ...] = ()
    """The signals over the variables of conditions, each after the signals that it reads."""
    has_margin: bool = False
    """Whether one of these signals is the margin of `when`."""
    on_sample: str | None = None
    """The stream at whose samples the rule is evaluated."""
    on_demand: bool = False
    priority: int = 0
    maximum_per_hour: int | None = None
    """The maximum number of episodes per client and hour; None: no limit."""

    @property
    def has_actions(self) -> bool:
        """Whether an episode has actions, for which its variables may be rendered."""
        return bool(self.deploys or self.actions)

    @property
    def common_signals(self) -> tuple[CompiledSignal, ...]:
        """The signals that are the same for all elements."""
        own = {signal.name for signal in self.elements[0].signals}
        return tuple(signal for signal in self.signals if signal.name not in own)

    @property
    def linked(self) -> frozenset[str]:
        """The streams whose previous samples it reads."""
        signals = [(signal.stream, each) for signal in self.signals for each in (signal.value, signal.where)]
        position = self.subject.position if isinstance(self.subject, PairSubject) else None
        axes = [] if position is None else [(position.stream, each) for each in position.axes.values()]
        return frozenset(stream for stream, each in (*signals, *axes) if each is not None and "before" in each.names)

    @property
    def streams(self) -> frozenset[str]:
        """The streams that it reads."""
        position = {self.subject.position.stream} if isinstance(self.subject, PairSubject) else set()
        seen = (source.stream for model in self.models for source in model.sensors)
        return frozenset({*position, *seen, *(signal.stream for signal in self.signals)})


@dataclass(frozen=True, slots=True)
class CompiledStream:
    """The expressions of a stream: the sender's time, the client and the items, if the Detector defines them."""

    name: str
    stamp: Expression | None
    client: CompiledTemplate | None = None
    items: Expression | None = None
