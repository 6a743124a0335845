"""A rule's comparisons with constants: `speed > 21`, `fastest - speed > parameters.most`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from detector.results.series import Doubles, Series, SeriesKind, SubjectTrace
from wayside.expressions import Expression, Path
from wayside.expressions.syntax import Call, Node, Scalar, Select, path_of
from wayside.rules import CompiledRule

_ORDER = {"_<_": "<", "_<=_": "<=", "_>_": ">", "_>=_": ">="}
_TURNED = {"<": ">", "<=": ">=", ">": "<", ">=": "<="}
_ARITHMETIC: Mapping[str, tuple[str, Callable[[Any, Any], Any]]] = {
    "_+_": ("+", np.add),
    "_-_": ("-", np.subtract),
    "_*_": ("*", np.multiply),
    "_/_": ("/", np.divide),
}


class Threshold(NamedTuple):
    """A comparison of a condition."""

    field: str
    """`when` or `until`."""
    term: str
    """The compared term: a signal's name, or the arithmetic over several as text."""
    operator: str
    value: float


class Terms(NamedTuple):
    """The terms that conditions compare, for one subject."""

    thresholds: tuple[Threshold, ...]
    computed: Mapping[str, Series]
    """The terms that are not signals themselves."""


def terms_of(rule: CompiledRule, subject: SubjectTrace) -> Terms:
    """The rule's comparisons with constants; parameters are those of the subject's client."""
    client = subject.clients[0] if len(subject.clients) == 1 else ""
    values = {"parameters": rule.parameters.of(client)}
    for element in rule.elements:
        if subject.subject.partition("~")[2] == (element.name or ""):
            values.update(element.variables)
    thresholds: dict[Threshold, None] = {}
    computed: dict[str, Series] = {}
    for field, expression in (("when", rule.when), ("until", rule.until)):
        if expression is None:
            continue
        for sign, term, other in _compared(expression):
            limit = _constant(other, expression.names, values)
            if limit is None or not term.signals <= subject.signals.keys():
                continue
            thresholds[Threshold(field, term.text, sign, limit)] = None
            if term.text not in subject.signals and term.text not in computed:
                computed[term.text] = _computed(term, expression.names, subject.signals)
    return Terms(tuple(thresholds), computed)


class _Term(NamedTuple):
    """The term of a comparison: a signal, or arithmetic over several."""

    node: Node
    text: str
    signals: frozenset[str]


@lru_cache(maxsize=1024)
def _compared(expression: Expression) -> tuple[tuple[str, _Term, Node], ...]:
    """The comparisons of a condition: the operator, a term, and its counterpart; each from both sides."""
    found = []
    for operator, left, right in _comparisons(expression.tree):
        for node, other, sign in ((left, right, operator), (right, left, _TURNED[operator])):
            text = _text(node, expression.names)
            if text is not None:
                found.append((sign, _Term(node, text, frozenset(_names(node, expression.names))), other))
    return tuple(found)


def _comparisons(node: Node) -> Iterator[tuple[str, Node, Node]]:
    if isinstance(node, Call):
        if node.function in _ORDER and node.target is None and len(node.arguments) == 2:
            yield _ORDER[node.function], *node.arguments
        for each in node.arguments:
            yield from _comparisons(each)


def _constant(node: Node, names: frozenset[str], values: Mapping[str, Any]) -> float | None:
    """The constant value of the node; None: it is not constant."""
    path = path_of(node, names)
    if path is not None:
        found: Any = values
        for step in path:
            found = found.get(step) if isinstance(found, Mapping) else None
        return float(found) if isinstance(found, int | float) and not isinstance(found, bool) else None
    match node:
        case Scalar(int() | float() as value) if not isinstance(value, bool):
            return float(value)
        case Call("-_", None, (operand,)):
            inner = _constant(operand, names, values)
            return None if inner is None else -inner
        case Call(function, None, (left, right)) if function in _ARITHMETIC:
            one, other = _constant(left, names, values), _constant(right, names, values)
            if one is None or other is None or (function == "_/_" and not other):
                return None
            return float(_ARITHMETIC[function][1](one, other))
    return None


def _text(node: Node, names: frozenset[str]) -> str | None:
    """The term as written; None if it is more than arithmetic over signals, or reads none."""
    if not any(True for _ in _names(node, names)):
        return None
    return _written(node, names)


def _written(node: Node, names: frozenset[str]) -> str | None:
    path = path_of(node, names)
    if path is not None:
        return None if path[0] == "parameters" or (isinstance(node, Select) and node.test_only) else _name(path)
    match node:
        case Scalar(int() | float() as value) if not isinstance(value, bool):
            return f"{value:g}"
        case Call(function, None, (left, right)) if function in _ARITHMETIC:
            one, other = (_nested(each, _written(each, names)) for each in (left, right))
            return None if one is None or other is None else f"{one} {_ARITHMETIC[function][0]} {other}"
    return None


def _nested(node: Node, text: str | None) -> str | None:
    return f"({text})" if text is not None and isinstance(node, Call) and node.function in _ARITHMETIC else text


def _names(node: Node, names: frozenset[str]) -> Iterator[str]:
    path = path_of(node, names)
    if path is not None:
        yield _name(path)
    elif isinstance(node, Call):
        for each in node.arguments:
            yield from _names(each, names)


def _name(path: Path) -> str:
    return ".".join(map(str, path))


def _computed(term: _Term, names: frozenset[str], signals: Mapping[str, Series]) -> Series:
    times = np.unique(np.concatenate([signals[name].times for name in sorted(term.signals)]))
    with np.errstate(all="ignore"):
        values = _values(term.node, names, lambda name: signals[name].at(times))
    values = np.broadcast_to(np.asarray(values, float), times.shape)
    kept = np.ones(len(times), bool)
    kept[1:] = (values[1:] != values[:-1]) & ~(np.isnan(values[1:]) & np.isnan(values[:-1]))
    return Series(times[kept], values[kept], SeriesKind.NUMBER)


def _values(node: Node, names: frozenset[str], of: Callable[[str], Doubles]) -> Any:
    path = path_of(node, names)
    if path is not None:
        return of(_name(path))
    match node:
        case Scalar(int() | float() as value):
            return float(value)
        case Call(function, None, (left, right)):
            return _ARITHMETIC[function][1](_values(left, names, of), _values(right, names, of))
    raise AssertionError(node)
