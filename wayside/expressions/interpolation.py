"""Strings with `${…}` in fields: compiled once, rendered for each set of values.

A string that consists of one `${…}` becomes the value of the expression, with its type; null drops the field: its key
or list item. Within other text, the value becomes text: strings unchanged, integral numbers without a decimal point,
`true` and `false`, lists and maps as JSON; null is an error there. `$${` is a literal `${`. Braces within CEL strings
do not count, and rendered values are never evaluated. Keys of maps are templates as well, and always become strings.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from wayside.expressions.cel import Environment, Expression
from wayside.expressions.errors import EvaluationError, ExpressionError, InterpolationError
from wayside.expressions.lexer import TokenKind, tokens
from wayside.expressions.numbers import MAX_EXACT
from wayside.expressions.syntax import Path

Json = None | bool | int | float | str | list["Json"] | dict[str, "Json"]
"""A JSON or YAML value."""

LITERAL: Final = "write `$${` for a literal `${`"


@dataclass(frozen=True, slots=True)
class Embedded:
    """An expression in the text of the field at `path`. It begins at `offset`, after its `${`."""

    expression: Expression
    path: str
    text: str
    offset: int

    def error(self, message: str, hint: str | None = None) -> InterpolationError:
        """An error at the position of the expression."""
        return InterpolationError(message, source=self.text, offset=self.offset, path=self.path, hint=hint)


@dataclass(frozen=True, slots=True)
class _Literal:
    value: Json


@dataclass(frozen=True, slots=True)
class _Mixed:
    """Text with expressions; `parts` has both in their order."""

    parts: tuple[str | Embedded, ...]


@dataclass(frozen=True, slots=True)
class _Map:
    members: tuple[tuple[str | _Mixed, _Node], ...]
    path: str


@dataclass(frozen=True, slots=True)
class _List:
    items: tuple[_Node, ...]


_Node = _Literal | Embedded | _Mixed | _Map | _List


class _Dropped:
    """The result of rendering a null: the field is removed."""


_DROPPED: Final = _Dropped()


@dataclass(frozen=True, slots=True)
class CompiledTemplate:
    """A compiled field, or tree of fields. `embedded` has its expressions."""

    root: _Node
    embedded: tuple[Embedded, ...]

    @property
    def names(self) -> frozenset[str]:
        """The variables that its expressions use."""
        return frozenset(name for each in self.embedded for name in each.expression.names)

    @property
    def paths(self) -> frozenset[Path]:
        """The literal paths that its expressions read."""
        return frozenset(path for each in self.embedded for path in each.expression.paths)

    def render(self, values: Mapping[str, object], *, integers: bool = False) -> Json:
        """The fields with the values filled in; None if the whole value was dropped.

        With `integers`, all integral doubles become integers, as manifests need them. Raises InterpolationError if
        an expression fails, is null inside a string, or yields a value that JSON cannot represent.
        """
        result = _render(self.root, values, integers)
        return None if isinstance(result, _Dropped) else result


Check = Callable[[Embedded], Iterable[InterpolationError]]  # finds further problems of an expression that compiles


def compile_template(
    value: Json, environment: Environment, *, path: str = "", check: Check = lambda _: ()
) -> CompiledTemplate:
    """Compiles all strings and keys of `value`; `path` is its path.

    Raises InterpolationError for the first invalid expression, with all further ones in its `others`.
    """
    compiler = _Compiler(environment, check)
    root = compiler.node(value, path)
    if compiler.errors:
        first = compiler.errors[0]
        first.others = (*first.others, *compiler.errors[1:])
        raise first
    return CompiledTemplate(root, tuple(compiler.embedded))


class _Compiler:
    """Walks a value and collects the expressions and the errors in it."""

    def __init__(self, environment: Environment, check: Check) -> None:
        self.environment = environment
        self.check = check
        self.embedded: list[Embedded] = []
        self.errors: list[InterpolationError] = []

    def node(self, value: Json, path: str) -> _Node:
        if isinstance(value, str):
            return self.text(value, path)
        if isinstance(value, Mapping):
            return _Map(tuple(self.member(key, each, path) for key, each in value.items()), path)
        if isinstance(value, (list, tuple)):
            return _List(tuple(self.node(each, f"{path}[{index}]") for index, each in enumerate(value)))
        return _Literal(value)

    def member(self, key: str, value: Json, path: str) -> tuple[str | _Mixed, _Node]:
        below = _join(path, str(key))
        name = self.text(key, below) if isinstance(key, str) else _Literal(key)
        node = self.node(value, below)
        match name:
            case _Mixed():
                return name, node
            case Embedded():
                return _Mixed((name,)), node
            case _Literal(str() as literal):
                return literal, node
        return key, node

    def text(self, text: str, path: str) -> _Literal | Embedded | _Mixed:
        parts: list[str | Embedded] = []
        literal: list[str] = []
        at = 0
        while (start := text.find("${", at)) >= 0:
            if start > at and text[start - 1] == "$":
                literal.append(text[at : start - 1] + "${")
                at = start + 2
                continue
            literal.append(text[at:start])
            end = _closing(text, start + 2)
            if end is None:
                self.errors.append(
                    InterpolationError("`${` is not closed", source=text, offset=start, path=path, hint=LITERAL)
                )
                return _Literal(text)
            if joined := "".join(literal):
                parts.append(joined)
            literal = []
            parts.extend(self.expression(text, path, start + 2, end))
            at = end + 1
        if rest := "".join(literal) + text[at:]:
            parts.append(rest)
        if len(parts) == 1:
            return parts[0] if isinstance(parts[0], Embedded) else _Literal(parts[0])
        return _Mixed(tuple(parts)) if parts else _Literal("")

    def expression(self, text: str, path: str, start: int, end: int) -> tuple[Embedded, ...]:
        try:
            expression = self.environment.compile(text[start:end])
        except ExpressionError as error:
            self.errors.extend(_relocated(each, text, path, start) for each in (error, *error.others))
            return ()
        embedded = Embedded(expression, path, text, start)
        self.embedded.append(embedded)
        self.errors.extend(self.check(embedded))
        return (embedded,)


def _closing(text: str, start: int) -> int | None:
    """The offset of the brace that closes the expression starting at `start`."""
    depth = 0
    for token in tokens(text, start):
        if token.text == "{" and token.kind is TokenKind.OPEN:
            depth += 1
        elif token.text == "}" and token.kind is TokenKind.CLOSE:
            if depth == 0:
                return token.start
            depth -= 1
    return None


def _relocated(error: ExpressionError, text: str, path: str, start: int) -> InterpolationError:
    """The error of an expression, with its position in the whole text. The usual mistake is a shell's `${HOME}`."""
    if not error.source.strip():
        hint = f"write an expression between the braces; {LITERAL}"
    else:
        hint = f"{error.hint}; {LITERAL}" if error.hint else LITERAL
    return InterpolationError(error.message, source=text, offset=start + error.offset, path=path, hint=hint)


def _render(node: _Node, values: Mapping[str, object], integers: bool) -> Json | _Dropped:
    match node:
        case _Literal(value):
            return _numbers(value, integers) if integers else value
        case Embedded():
            value = _json(node, values)
            if value is None:
                return _DROPPED
            return _numbers(value, integers)
        case _Mixed():
            return _joined(node, values)
        case _List(items):
            each = (_render(item, values, integers) for item in items)
            return [item for item in each if not isinstance(item, _Dropped)]
        case _Map(members, path):
            result: dict[str, Json] = {}
            for key, member in members:
                rendered = _render(member, values, integers)
                if isinstance(rendered, _Dropped):
                    continue
                name = key if isinstance(key, str) else _joined(key, values)
                if name in result:
                    raise InterpolationError(f"two keys render to {name!r}", path=path, hint="make them differ")
                result[name] = rendered
            return result


def _joined(mixed: _Mixed, values: Mapping[str, object]) -> str:
    return "".join(part if isinstance(part, str) else _text(part, values) for part in mixed.parts)


def _text(embedded: Embedded, values: Mapping[str, object]) -> str:
    value = _json(embedded, values)
    if value is None:
        hint = 'give a value for that case, as in `x == null ? "" : x`'
        raise embedded.error(f"`{embedded.expression.source.strip()}` is null inside a string", hint)
    if isinstance(value, str):
        return value
    return json.dumps(_numbers(value, integers=True), ensure_ascii=False, separators=(",", ":"))


def _json(embedded: Embedded, values: Mapping[str, object]) -> Json:
    try:
        return _checked(embedded.expression.evaluate(values))
    except EvaluationError as error:
        raise embedded.error(f"`{embedded.expression.source.strip()}`: {error.message}") from None


def _checked(value: object) -> Json:
    """The value as JSON. Raises EvaluationError for NaN, infinities and bytes, which JSON cannot represent."""
    match value:
        case float() if not math.isfinite(value):
            raise EvaluationError(f"yields {value}, which JSON cannot represent")
        case None | bool() | int() | float() | str():
            return value
        case list():
            return [_checked(item) for item in value]
        case dict():
            return {_key_text(key): _checked(item) for key, item in value.items()}
    raise EvaluationError(f"yields {type(value).__name__}, which JSON cannot represent")


def _key_text(key: object) -> str:
    return key if isinstance(key, str) else json.dumps(key)


def _numbers(value: Json, integers: bool) -> Json:
    if not integers:
        return value
    match value:
        case float() if value.is_integer() and abs(value) <= MAX_EXACT:
            return int(value)
        case list():
            return [_numbers(item, integers) for item in value]
        case dict():
            return {key: _numbers(item, integers) for key, item in value.items()}
    return value


def _join(path: str, key: str) -> str:
    """The path of a member. Keys with special characters are quoted, as in `metadata.labels["wayside.dev/x"]`."""
    if key.replace("_", "").replace("-", "").isalnum():
        return f"{path}.{key}" if path else key
    return f"{path}[{json.dumps(key, ensure_ascii=False)}]"
