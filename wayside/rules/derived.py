"""Compiles the signals over the variables of conditions: signals of signals, and statistics of the open episode."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from wayside.api.documents import FieldPath
from wayside.api.eventrule import Aggregate, Signal
from wayside.expressions import CelType, Environment, Expression
from wayside.rules.compiled import CompiledDerived
from wayside.rules.compiler import Compiler
from wayside.rules.margins import MARGIN, MarginError, margin_of


def compile_derived(compiler: Compiler, environment: Environment) -> tuple[CompiledDerived, ...]:
    """The signals over the variables of conditions, each after the signals that it reads."""
    found: dict[str, CompiledDerived] = {}
    places: dict[str, FieldPath] = {}
    for index, signal in enumerate(compiler.rule.spec.signals):
        if not signal.is_derived:
            continue
        at: FieldPath = ("spec", "signals", index)
        of = compiler.condition((*at, "of"), signal.of, environment, CelType.DYN)
        if of is None and signal.of is not None:
            continue
        places[signal.name] = (*at, "of")
        found[signal.name] = _compiled(compiler, at, signal, of)
    if compiler.rule.spec.margin is not None and (of := _margin(compiler, environment)) is not None:
        places[MARGIN] = ("spec", MARGIN)
        found[MARGIN] = CompiledDerived(MARGIN, of, Aggregate.LAST, 0, 0)
    for name, derived in found.items():
        for text in () if derived.of is None else statistics_read(derived.of, found.values()):
            compiler.problem(places[name], text)
    ordered = [*_in_order(found)]
    for name in [name for name in found if name not in ordered]:
        compiler.problem(places[name], f"{name} depends on itself: remove one of the signals that it reads")
    return tuple(found[name] for name in ordered)


def _margin(compiler: Compiler, environment: Environment) -> Expression | None:
    """The margin of `when`; None, with a problem, if it can have none."""
    spec = compiler.rule.spec
    for index, signal in enumerate(spec.signals):
        if signal.name == MARGIN:
            compiler.problem(
                ("spec", "signals", index, "name"), "is the name of the rule's margin: choose another name"
            )
            return None
    try:
        return compiler.condition(("spec", MARGIN), margin_of(spec), environment, CelType.DOUBLE)
    except MarginError as error:
        compiler.problem(error.path, str(error))
        return None


def statistics_read(expression: Expression, derived: Iterable[CompiledDerived]) -> Iterator[str]:
    """The problems of an expression outside of actions that reads a statistic of the open episode."""
    for name in sorted(expression.names & {each.name for each in derived if each.episode}):
        yield f"{name} is known only while an episode is open: use it in actions; conditions and signals cannot read it"


def _compiled(compiler: Compiler, at: FieldPath, signal: Signal, of: Expression | None) -> CompiledDerived:
    episode = signal.over is not None and signal.over.is_episode
    kept = compiler.detector.spec.buffer.duration
    lag = 0 if signal.lag is None else signal.lag.ns
    over = kept.ns if signal.over is None or episode else signal.over.ns
    if over + lag > kept.ns and (signal.over is not None or lag > kept.ns):
        field = "lag" if signal.lag is not None else "over"
        compiler.problem(
            (*at, field),
            f"over and lag reach back {(lag + (over if signal.over is not None else 0)) / 1e9:g} s, longer than the "
            f"{kept} that Detector {compiler.detector.name} keeps: shorten them, or raise buffer.duration",
        )
    return CompiledDerived(signal.name, of, signal.aggregate, over, lag, signal.quantile, episode)


def _in_order(derived: Mapping[str, CompiledDerived]) -> Iterator[str]:
    """The names, each after those that it reads, without those that depend on themselves."""
    reads = {name: each.of.names & derived.keys() if each.of else frozenset() for name, each in derived.items()}
    done: set[str] = set()
    while ready := [name for name in reads if name not in done and reads[name] <= done]:
        yield from ready
        done.update(ready)
