"""A rule as the engine evaluates it: expressions compiled, durations in nanoseconds."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from wayside.api.eventrule import Aggregate
from wayside.expressions import CompiledTemplate, Expression


@dataclass(frozen=True, slots=True)
class CompiledSignal:
    """How one signal is computed."""

    name: str
    stream: str
    aggregate: Aggregate
    value: Expression | None
    where: Expression | None
    over_ns: int | None


@dataclass(frozen=True, slots=True)
class CompiledPosition:
    """How a client's position is computed; metres."""

    stream: str
    x: Expression
    y: Expression
    z: Expression | None


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


@dataclass(frozen=True, slots=True)
class CompiledDeploy:
    """A deploy action; its parameters are rendered over the rule's variables."""

    action: str
    template: str
    priority: int
    source: str
    """The parameters as written, in canonical JSON."""
    parameters: CompiledTemplate = field(compare=False)


@dataclass(frozen=True, slots=True)
class CompiledRule:
    """A rule, ready to be evaluated."""

    name: str
    subject: ClientSubject | PairSubject
    signals: tuple[CompiledSignal, ...]
    when: Expression
    until: Expression | None
    every_ns: int
    for_ns: int
    cooldown_ns: int
    unknown_timeout_ns: int
    enabled: bool
    dry_run: bool
    deploys: tuple[CompiledDeploy, ...]
    classification: dict[str, Any] | None
    digest: str
    """Of the fields that decide which episodes there are: open episodes end when it changes."""


@dataclass(frozen=True, slots=True)
class CompiledStream:
    """How a sample of a stream tells the sender's time, where the Detector says so."""

    name: str
    stamp: Expression | None
