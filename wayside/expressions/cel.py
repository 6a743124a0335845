"""The one interface to CEL: declare variables, compile an expression, evaluate it on values.

An `Environment` has the declared variables and compiles expressions; an `Expression` can be evaluated any number of
times, from any thread. Unknown values follow Kleene's logic: CEL propagates an error through `&&`, `||`, `!` and `?:`
exactly as Kleene's logic propagates the unknown. So unknown values are left out of the input (see `projection`), and an
error means unknown. (A NaN that results inside an expression, from 0/0 or inf − inf, takes part in the evaluation:
comparisons with it are false, as in IEEE 754, and it is unknown only as the result.)
"""

from __future__ import annotations

import datetime
import enum
import math
import re
from collections.abc import Callable, Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import Final

from cel_expr_python import cel

from wayside.expressions.bounds import LARGEST_PATTERN, MOST, growth, pattern_size
from wayside.expressions.diagnostics import EMPTY, NO_MEMBERS, clean, diagnose, reports_absent
from wayside.expressions.errors import EvaluationError, ExpressionError
from wayside.expressions.expanding import NamedPlaces, expanded
from wayside.expressions.functions import DECLARATIONS, TAKING_HANDLES
from wayside.expressions.functions.calls import drop_lost_references
from wayside.expressions.handles import begin, end, value_of
from wayside.expressions.lexer import tokens
from wayside.expressions.numbers import MAX_EXACT, doubled
from wayside.expressions.projection import Leaf, missing_path, no_member, normalise, project, tree
from wayside.expressions.syntax import (
    Node,
    Path,
    Scalar,
    Select,
    arguments,
    calls,
    nothing_but_arguments,
    parse,
    path_of,
    paths,
)
from wayside.expressions.unknown import UNKNOWN, Reason, Unknown
from wayside.geo.geometry import Shape

Value = None | bool | int | float | str | bytes | list["Value"] | dict[str | int | bool, "Value"]
"""The result of an expression: plain data. An int is always beyond 2^53."""

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_CACHE_SIZE = 1024
_SHARED = 256
"""The maximum number of shared environments and programs; the least recently used are dropped."""
_ORDERING = frozenset({"_<_", "_<=_", "_>_", "_>=_"})


class CelType(enum.Enum):
    """The type of a variable or a result. DYN is checked only at evaluation."""

    DYN = "any value"
    DOUBLE = "a number"
    STRING = "a string"
    BOOL = "a boolean"
    MAP = "a map"
    LIST = "a list"


_TYPES: Final[Mapping[CelType, tuple[cel.Type, type | tuple[type, ...]]]] = {
    CelType.DYN: (cel.Type.DYN, object),
    CelType.DOUBLE: (cel.Type.DOUBLE, (float, int)),
    CelType.STRING: (cel.Type.STRING, str),
    CelType.BOOL: (cel.Type.BOOL, bool),
    CelType.MAP: (cel.Type.Map(cel.Type.STRING, cel.Type.DYN), dict),
    CelType.LIST: (cel.Type.List(cel.Type.DYN), list),
}
"""Each type in CEL and in Python."""
_NAMED_KINDS: Final = {
    "BOOL": CelType.BOOL,
    "DOUBLE": CelType.DOUBLE,
    "INT": CelType.DOUBLE,
    "UINT": CelType.DOUBLE,
    "STRING": CelType.STRING,
}
_WORDS: Final = (
    "as break const continue else false for function if import in let loop namespace null package return true var void"
    " while"
)
RESERVED_WORDS: Final = frozenset(_WORDS.split())
"""The reserved words of CEL's grammar: no variable can have one as its name."""


_LITERAL: Final = "write it in quotes; parameters, fields and sums are not allowed"
_SMALLER: Final = "nested loops multiply the values that `+` joins: join fewer"


class Environment:
    """The variables that expressions may use. Immutable; compiled expressions are cached."""

    def __init__(
        self,
        variables: Mapping[str, CelType],
        members: Mapping[str, CelType] | None = None,
        places: NamedPlaces | None = None,
    ) -> None:
        """`members` has the known types of members of maps, by their paths, such as `parameters.maxSpeed`.

        They help to find wrong types at compilation, and do not change the result of an expression.
        """
        self._places = places or NamedPlaces()
        for name in variables:
            if not _NAME.fullmatch(name):
                raise ValueError(f"variable {name!r}: not a CEL identifier; use letters, digits and `_`")
            if name in RESERVED_WORDS:
                raise ValueError(f"variable {name!r}: CEL reserves this word; choose another name")
        self.variables: Mapping[str, CelType] = MappingProxyType(dict(variables))
        self._members: Mapping[str, CelType] = MappingProxyType(dict(members or {}))
        self._env = _cel_environment(tuple(self.variables.items()))
        typed = tuple({**self.variables, **self._members}.items())
        self._typed = _cel_environment(typed) if self._members else None
        self._cache: dict[tuple[str, CelType], Expression] = {}

    def knowing(self, members: Mapping[str, CelType]) -> Environment:
        """The same environment, with the types of more members."""
        return Environment(self.variables, {**self._members, **members}, self._places) if members else self

    def naming(self, places: NamedPlaces) -> Environment:
        """The same environment, with places that expressions can name."""
        return Environment(self.variables, self._members, places)

    def compile(self, source: str, *, result: CelType = CelType.DYN) -> Expression:
        """Compiles `source`. If its type is known only at evaluation, `result` is checked then.

        Raises ExpressionError, with a position in `source`, if it does not parse, has the wrong type or uses an
        undeclared name.
        """
        if not isinstance(source, str):
            raise _not_text(source)
        cached = self._cache.get((source, result))
        if cached is not None:
            return cached
        if not source.strip():
            raise ExpressionError("the expression is empty", source=source, hint=EMPTY)
        whole = expanded(source, self._places)
        rewritten = doubled(whole.text, whole.origin)
        try:
            program = _program(self._env, rewritten.text)
            parsed = parse(program.serialize())
            read, leaves = self._reads(parsed)
            # `has(a.b)` tests for a member of a map; it would not if `a.b` were a variable.
            untyped = self._typed is None or "has(" in rewritten.text
            typed = program if untyped else _program(self._typed, rewritten.text)
        except Exception as error:  # noqa: BLE001 (the binding raises RuntimeError, ValueError and others alike)
            raise diagnose(str(error), source, rewritten, self.variables) from None
        _check_patterns(parsed, source)
        if growth(parsed) > MOST:
            raise ExpressionError(
                f"the result could contain more than {MOST} copies of other values", source=source, hint=_SMALLER
            )
        _check_static(typed.return_type(), result, source)
        expression = Expression(source, program, read, leaves, result, self.variables, whole.shapes)
        if len(self._cache) >= _CACHE_SIZE:
            self._cache.clear()  # bounds the memory if rules change for months; each recompilation costs 50 µs
        self._cache[source, result] = expression
        return expression

    def _reads(self, node: Node) -> tuple[frozenset[Path], Mapping[Path, Leaf]]:
        """The paths that are read, and how each is read.

        A path can become a handle only if CEL knows no type for it.
        """
        names = frozenset(self.variables)
        leaves = dict.fromkeys(arguments(node, names, _ORDERING), Leaf.ORDERED)
        for path in nothing_but_arguments(node, names, TAKING_HANDLES):
            if len(path) > 1 or self.variables[str(path[0])] is CelType.DYN:
                leaves[path] = Leaf.HANDED
        return paths(node, names), leaves


@lru_cache(maxsize=_SHARED)
def _cel_environment(variables: tuple[tuple[str, CelType], ...]) -> cel.Env:
    """Rules with equal variables share one environment: its creation takes as long as compiling an expression."""
    return cel.NewEnv(variables={name: _TYPES[kind][0] for name, kind in variables}, functions=list(DECLARATIONS))


@lru_cache(maxsize=_SHARED)
def _program(environment: cel.Env, text: str) -> cel.Expression:
    """Rules often read the same fields of a stream, so programs are shared. Raises the errors of the binding."""
    return environment.compile(text)


class Expression:
    """A compiled expression. `paths` are the literal paths that it reads; `names` and `kinds` describe their variables.

    `places` are the places that it names.
    """

    __slots__ = ("_program", "_read", "kinds", "names", "paths", "places", "result", "source")

    def __init__(
        self,
        source: str,
        program: cel.Expression,
        read: frozenset[Path],
        leaves: Mapping[Path, Leaf],
        result: CelType,
        variables: Mapping[str, CelType],
        places: tuple[Shape, ...],
    ) -> None:
        self.source = source
        self.places = places
        self.paths = read
        self.names = frozenset(str(path[0]) for path in read)
        self.kinds: Mapping[str, CelType] = {name: variables[name] for name in self.names}
        self.result = result
        self._program = program
        self._read = tree(read, leaves)

    def __repr__(self) -> str:
        return f"Expression({self.source!r})"

    @property
    def tree(self) -> Node:
        """The syntax tree that CEL evaluates: macros are expanded, numbers are doubles. Decoded at each call."""
        return parse(self._program.serialize())

    @property
    def path(self) -> Path | None:
        """The literal path, if the whole expression is one; otherwise None. Decoded at each call."""
        tree = self.tree
        return None if isinstance(tree, Select) and tree.test_only else path_of(tree, self.names)

    def evaluate(self, values: Mapping[str, object]) -> Value:
        """The result on `values`, in which null stays null. Integral results are doubles, maps are sorted by key.

        Raises EvaluationError if the expression fails, reads an absent variable or key, or yields another type than
        it was compiled for.
        """
        try:
            return self._run(values, known=False)
        except EvaluationError as error:
            missing = missing_path(self.paths, values) if error.absent else None
            if missing is None:
                raise
            raise EvaluationError(missing, absent=True) from None

    def evaluate_or_unknown(
        self, values: Mapping[str, object], on_unknown: Callable[[Reason, str], None] | None = None
    ) -> Value | Unknown:
        """The result on `values`, or UNKNOWN if it depends on an absent value, null or NaN, or the expression fails.

        `on_unknown` receives the reason and a message. Never raises because of the values. Since null is unknown,
        `x == null` is never true: use `has(msg.x)`, which is false for an absent, null or NaN field.
        """
        value, why = self.explained(values)
        if why is not None and on_unknown is not None:
            on_unknown(*why)
        return value

    def explained(self, values: Mapping[str, object]) -> tuple[Value | Unknown, tuple[Reason, str] | None]:
        """The same, with the reason and a message if the result is UNKNOWN; None if it is known."""
        try:
            value = self._run(values, known=True)
        except EvaluationError as error:
            return UNKNOWN, (Reason.ABSENT if error.absent else Reason.ERROR, error.message)
        if value is None or (isinstance(value, float) and math.isnan(value)):
            return UNKNOWN, (Reason.ABSENT, "the result is null" if value is None else "the result is not a number")
        return value, None

    def _run(self, values: Mapping[str, object], *, known: bool) -> Value:
        before = begin()
        try:
            return self._run_holding(values, known=known)
        finally:
            end(before)
            if before is None:
                drop_lost_references()

    def _run_holding(self, values: Mapping[str, object], *, known: bool) -> Value:
        try:
            return self._result(values, known=known)
        except EvaluationError as error:
            message = no_member(self.paths, values) if error.message in NO_MEMBERS else None
            if message is None:
                raise
            raise EvaluationError(message, absent=error.absent) from None

    def _result(self, values: Mapping[str, object], *, known: bool) -> Value:
        try:
            data = project(self._read, values, known=known)
        except RecursionError:
            raise EvaluationError("the values are nested too deeply") from None
        try:
            outcome = self._program.eval(data=data)
            value = outcome.plain_value()
            failed = isinstance(value, str) and outcome.type() == cel.Type.ERROR
        except Exception as error:  # noqa: BLE001 (the binding raises RuntimeError, ValueError and others alike)
            raise EvaluationError(clean(str(error))) from None
        if failed:
            message = clean(value)
            raise EvaluationError(message, absent=reports_absent(message) or (known and "null" in message))
        result = _plain(value)
        if self.result is not CelType.DYN:
            self._check(result)
        return result

    def _check(self, value: Value) -> None:
        wanted = _TYPES[self.result][1]
        if isinstance(value, wanted) and not (isinstance(value, bool) and self.result is CelType.DOUBLE):
            return
        raise EvaluationError(f"must be {self.result.value}; got {_describe(value)}", absent=value is None)


def _check_static(actual: cel.Type, wanted: CelType, source: str) -> None:
    name = actual.name()
    kind = _NAMED_KINDS.get(name)
    if wanted is CelType.DYN or name == "DYN" or wanted is kind or name.split("<")[0] == wanted.name:
        return
    start = len(source) - len(source.lstrip())
    is_text = kind.value if kind else name.lower()
    raise ExpressionError(f"must be {wanted.value}; got {is_text}", source=source, offset=start)


def _check_patterns(node: Node, source: str) -> None:
    """Raise ExpressionError if the pattern of `matches` is not a literal, or is too large."""
    found = list(calls(node, "matches"))
    names = [each.start for each in tokens(source) if each.text == "matches"] if found else []
    for index, call in enumerate(found):
        pattern = call.arguments[-1] if call.arguments else None
        literal = pattern.value if isinstance(pattern, Scalar) else None
        if not isinstance(literal, str):
            message, hint = "the pattern of `matches` must be a literal string", _LITERAL
        elif (size := pattern_size(literal)) > LARGEST_PATTERN:
            cut = literal if len(literal) <= 80 else f"{literal[:79]}…"
            message = f"the pattern of `matches` must take at most {LARGEST_PATTERN} steps; {cut!r} takes {size}"
            hint = "use fewer repetitions, or smaller character classes"
        else:
            continue
        offset = names[index] if len(names) == len(found) else 0
        raise ExpressionError(message, source=source, offset=offset, hint=hint)


def _not_text(source: object) -> ExpressionError:
    if source is None:
        return ExpressionError("the expression is empty", source="", hint=EMPTY)
    written = str(source).lower() if isinstance(source, bool) else str(source)
    return ExpressionError(
        f"an expression must be a string; got {type(source).__name__} {written}",
        source=written,
        hint=f'put it in quotes: "{written}"',
    )


def _plain(value: object) -> Value:
    if value is None or isinstance(value, (bool, float, str)):
        return value
    if isinstance(value, int):
        held = value_of(value)
        if held is not value:
            return bytes(held) if isinstance(held, bytes | bytearray | memoryview) else _plain(normalise(held))
        return float(value) if -MAX_EXACT <= value <= MAX_EXACT else value
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, dict):  # CEL's order differs between processes
        return {key: _plain(value[key]) for key in sorted(value, key=str)}
    if isinstance(value, (bytearray, bytes)):
        return bytes(value)
    if isinstance(value, datetime.datetime):
        return value.isoformat().replace("+00:00", "Z")
    if isinstance(value, datetime.timedelta):
        return value.total_seconds()
    raise EvaluationError(f"yields {_describe(value)}, which is not data")


def _describe(value: object) -> str:
    if value is None:
        return "null"
    names = {bool: "a boolean", float: "a number", int: "a number", str: "a string", list: "a list", dict: "a map"}
    return names.get(type(value), f"a value of type {type(value).__name__}")
