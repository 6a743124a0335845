"""The margin of a condition: its distance from the next change.

It is the robustness of signal temporal logic: the signed distance of each comparison from its threshold in units of a
scale, the smaller of both sides for `&&`, the larger for `||`, and the negative for `!`. It is a CEL expression, so
unknown values stay unknown, in columns as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from wayside.api.documents import FieldPath
from wayside.api.eventrule import EventRuleSpec
from wayside.expressions.lexer import Token, TokenKind, tokens

MARGIN = "margin"
"""The name of the signal."""

_SPACE = (TokenKind.SPACE, TokenKind.COMMENT)
_ORDER = ("<", "<=", ">", ">=", "==", "!=")
_OPEN, _CLOSE = ("(", "[", "{"), (")", "]", "}")
_NO_NUMBERS = ("true", "false", "null")


class MarginError(Exception):
    """The margin of a rule is not valid; `path` is the field."""

    def __init__(self, path: FieldPath, message: str) -> None:
        super().__init__(message)
        self.path = path


def margin_of(spec: EventRuleSpec) -> str:
    """The expression of the margin of `when`. Raises MarginError."""
    scales = spec.margin or {}
    quantities = {signal.name for signal in spec.signals}
    quantities |= {"distance", "closingSpeed"} if spec.scope.pairs is not None else set()
    for name in scales:
        if name not in quantities:
            known = ", ".join(sorted(quantities)) or "none"
            raise MarginError(("spec", "margin", name), f"the rule has no signal {name}; it has {known}")
    text = [token for token in tokens(spec.when) if token.kind not in _SPACE]
    found = _Margin(spec.when, scales, quantities)
    written = found.either(text)
    found.check()
    return written


class _Comparison(NamedTuple):
    text: str
    quantities: frozenset[str]
    scaled: bool


class _Margin:
    """Translates a condition into its margin."""

    def __init__(self, source: str, scales: Mapping[str, float], quantities: set[str]) -> None:
        self._source, self._scales, self._quantities = source, scales, quantities
        self._comparisons: list[_Comparison] = []

    def either(self, text: Sequence[Token]) -> str:
        parts = [*_split(text, ("||",))]
        return _joined("larger", [self._both(part) for part in parts])

    def check(self) -> None:
        """Raises MarginError if comparisons are of different quantities and one has no scale."""
        unscaled = [each for each in self._comparisons if not each.scaled]
        if unscaled and len({each.quantities for each in self._comparisons}) > 1:
            names = " or ".join(sorted(unscaled[0].quantities)) or "a signal that it reads"
            raise MarginError(
                ("spec", MARGIN),
                f"`{unscaled[0].text}` needs a scale, since `when` compares different quantities: add {names}, with "
                "the difference that counts as a margin of 1",
            )

    def _both(self, text: Sequence[Token]) -> str:
        return _joined("smaller", [self._one(part) for part in _split(text, ("&&",))])

    def _one(self, text: Sequence[Token]) -> str:
        if _is_group(text):
            return self.either(text[1:-1])
        if text and text[0].text == "!" and (_is_group(text[1:]) or (text[1:2] and text[1].text == "!")):
            return f"-({self._one(text[1:])})"
        return self._comparison(text)

    def _comparison(self, text: Sequence[Token]) -> str:
        sides = [*_split(text, _ORDER)]
        loose = {token.text for side in sides for token in _at_the_top(side)}
        odd = any(token.kind is TokenKind.STRING for side in sides for token in _at_the_top(side))
        if len(sides) != 2 or not all(sides) or odd or loose & {"?", "in", "!", *_NO_NUMBERS}:
            written = self._text(text) or "an empty part"
            raise MarginError(
                ("spec", "when"),
                f"a margin needs comparisons of numbers, joined by &&, || and !, but `{written}` is not one: "
                "compare numbers, or remove margin",
            )
        operator = next(token.text for token in _at_the_top(text) if token.text in _ORDER)
        names = frozenset(token.text for token in text if token.text in self._quantities)
        scales = {self._scales[name] for name in names if name in self._scales}
        if len(scales) > 1:
            raise MarginError(
                ("spec", MARGIN),
                f"`{self._text(text)}` reads {' and '.join(sorted(names))}, which have different scales: define "
                "this part as a signal with of, and give that signal a scale",
            )
        self._comparisons.append(_Comparison(self._text(text), names, bool(scales)))
        left, right = (f"({self._text(side)})" for side in sides)
        if operator in ("<", "<="):
            left, right = right, left
        difference = f"({left} - {right})"
        if operator in ("==", "!="):
            difference = f"{'-' if operator == '==' else ''}abs{difference}"
        return f"{difference} / {float(scales.pop())!r}" if scales else difference

    def _text(self, text: Sequence[Token]) -> str:
        return self._source[text[0].start : text[-1].start + len(text[-1].text)] if text else ""


def _joined(function: str, parts: Sequence[str]) -> str:
    written = parts[-1]
    for part in reversed(parts[:-1]):
        written = f"{function}({part}, {written})"
    return written


def _depths(text: Sequence[Token]) -> Iterator[tuple[Token, int]]:
    depth = 0
    for token in text:
        depth -= token.text in _CLOSE
        yield token, depth
        depth += token.text in _OPEN


def _at_the_top(text: Sequence[Token]) -> Iterator[Token]:
    """The tokens outside of all brackets."""
    return (token for token, depth in _depths(text) if depth == 0)


def _split(text: Sequence[Token], operators: Sequence[str]) -> Iterator[Sequence[Token]]:
    """The parts between these operators, outside of all brackets."""
    begin = 0
    for at, (token, depth) in enumerate(_depths(text)):
        if depth == 0 and token.text in operators:
            yield text[begin:at]
            begin = at + 1
    yield text[begin:]


def _is_group(text: Sequence[Token]) -> bool:
    """Whether one pair of parentheses encloses the whole text."""
    if not text or text[0].text != "(" or text[-1].text != ")":
        return False
    return all(depth > 0 for _, depth in [*_depths(text)][1:-1])
