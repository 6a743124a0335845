"""Compiles the scope of a rule, and the elements of `each`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from wayside.api.documents import FieldPath
from wayside.api.scopes import Each, PairsScope
from wayside.expressions import CelType, Expression
from wayside.rules.compiled import (
    ClientSubject,
    CompiledElement,
    CompiledModel,
    CompiledPosition,
    CompiledSignal,
    CompiledSubject,
    FleetSubject,
    PairSubject,
)
from wayside.rules.compiler import Compiler
from wayside.rules.variables import (
    client_environment,
    element_name_problem,
    element_of,
    pairs_environment,
    signal_names,
)

CLOSING_NS = 1_000_000_000
"""The time over which the closing speed is measured, in nanoseconds."""


def compile_subject(compiler: Compiler) -> CompiledSubject | None:
    """The compiled scope; None if it has problems. `with_closing_speed` completes it later."""
    spec = compiler.rule.spec
    element = element_of(spec)
    if spec.scope.pairs is not None:
        return _pairs(compiler, spec.scope.pairs, element)
    if spec.scope.fleet is not None:
        members = compiler.condition(
            ("spec", "scope", "fleet", "members"),
            spec.scope.fleet.members,
            client_environment(signal_names(spec), element),
        )
        return None if members is None else FleetSubject(members)
    assert spec.scope.client is not None  # noqa: S101  the model has exactly one
    return ClientSubject(
        compiler.condition(
            ("spec", "scope", "client", "where"), spec.scope.client.where, client_environment((), element)
        )
    )


def _pairs(compiler: Compiler, pairs: PairsScope, element: str | None) -> PairSubject | None:
    at: FieldPath = ("spec", "scope", "pairs")
    position = pairs.position
    stream = compiler.stream((*at, "position", "stream"), position.stream)
    axes: dict[str, Expression] = {}
    complete = position.x is not None or position.latitude is not None
    if not complete and stream is not None:
        compiler.problem(
            (*at, "position", "stream"),
            f"stream {stream.name} has no position: give x and y, or latitude and longitude, or set position in this "
            "stream of the Detector",
        )
    for axis in ("x", "y", "z", "latitude", "longitude"):
        source = getattr(position, axis)
        if source is not None:
            expression = compiler.sample((*at, "position", axis), source, stream, CelType.DOUBLE)
            if expression is None:
                complete = False
            else:
                axes[axis] = expression
    where = compiler.condition((*at, "where"), pairs.where, pairs_environment(element))
    role = client_environment((), element)
    a = None if pairs.a is None else compiler.condition((*at, "a", "where"), pairs.a.where, role)
    b = None if pairs.b is None else compiler.condition((*at, "b", "where"), pairs.b.where, role)
    if not complete:
        return None
    max_age = position.max_age_ns(never_stale=stream is not None and stream.never_stale)
    return PairSubject(
        CompiledPosition(position.stream, axes, compiler.parameters, max_age),
        pairs.within,
        where,
        a,
        b,
        pairs.max_pairs,
    )


def compile_elements(compiler: Compiler, each: Each | None) -> tuple[CompiledElement, ...]:
    """The elements for which the rule is evaluated, ordered by name; one without a name if the rule has no `each`."""
    if each is None:
        return (CompiledElement(),)
    spec, name, at = compiler.rule.spec, each.as_, ("spec", "each", "as")
    if (problem := element_name_problem(name, spec)) is not None:
        compiler.problem(at, problem)
    return tuple(
        CompiledElement(element.name, {name: element.to_json()}) for element in sorted(each.of, key=lambda e: e.name)
    )


def with_signals(
    elements: Sequence[CompiledElement], variable: str | None, signals: Sequence[CompiledSignal]
) -> tuple[CompiledElement, ...]:
    """The elements, each with the signals that read it."""
    if variable is None:
        return tuple(elements)
    reading = [signal for signal in signals if _reads(signal, variable)]
    return tuple(
        replace(element, signals=tuple(replace(signal, element=element) for signal in reading)) for element in elements
    )


def check_models(compiler: Compiler, elements: Sequence[CompiledElement], models: Sequence[CompiledModel]) -> None:
    """Report models whose inputs depend on the element: a model runs only once per client."""
    own = {signal.name for signal in elements[0].signals}
    for model in models:
        for index, given in enumerate(model.source.inputs):
            names = given.window.signals if given.window is not None else given.signals
            for name in names or ():
                if name in own:
                    path: FieldPath = ("spec", "signals", model.index, "model", "inputs", index)
                    compiler.problem(
                        path, f"{name} reads the element of each, but a model runs once per client: remove it"
                    )


def _reads(signal: CompiledSignal, variable: str) -> bool:
    return any(variable in each.names for each in (signal.value, signal.where) if each is not None)


def with_closing_speed(
    compiler: Compiler, subject: CompiledSubject, conditions: Iterable[Expression | None]
) -> CompiledSubject:
    """The subject, with the closing speed if any expression uses it."""
    if not isinstance(subject, PairSubject):
        return subject
    if not any("closingSpeed" in each.names for each in (*conditions, subject.where) if each is not None):
        return subject
    stream = compiler.detector.spec.stream(subject.position.stream)
    if stream is not None and (kept := compiler.retention_ns(stream)) <= CLOSING_NS:
        compiler.problem(
            ("spec", "scope", "pairs", "position", "stream"),
            f"closingSpeed needs samples of the last second, but stream {stream.name} is kept for {kept / 1e9:g} s "
            "only: raise the stream's buffer.duration to 2s or more",
        )
    return replace(subject, closing_speed=True)
