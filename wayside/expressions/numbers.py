"""Numbers are doubles: rewrites an expression so that CEL, which never mixes integers with doubles, sees only doubles.

    speed > 3                 →  speed > 3.0
    size(points) / 2          →  double(size(points)) / 2.0
    ranges[0] + ranges[i + 1] →  ranges[0] + ranges[dyn(i + 1.0)]
    string(msg.station)       →  string(digits(msg.station))
    name.matches('a+')        →  bounded(name).matches('a+')

Integer literals become doubles, and so do the results of functions that count, and of `int(x)`, which truncates. A
literal index stays an integer; any other index is wrapped in `dyn()`, because a list accepts an integral double as
index at run time, but not in the type check. Integers stay where CEL accepts only integers: beside `%`, as the argument
of `timestamp` and of `string`, and beyond 2^53, where a double would be another number. `digits` turns a whole double
back into an integer, since `string` writes large doubles with an exponent. The same pass inserts `bounded` (see
`bounds`). Strings, comments and `3u` do not change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from wayside.expressions.bounds import BOUNDED
from wayside.expressions.lexer import Token, TokenKind, tokens

MAX_EXACT = 2**53
"""The largest integer up to which every integer is exact as a double."""

DIGITS = "digits"
"""An internal function that prepares the argument of `string`."""

_COUNTING_METHODS = frozenset(
    {"size"}
    | {f"get{part}" for part in ("FullYear", "Month", "Date", "DayOfMonth", "DayOfWeek", "DayOfYear")}
    | {f"get{part}" for part in ("Hours", "Minutes", "Seconds", "Milliseconds")}
)
_PAIRS = {")": "(", "]": "[", "}": "{"}


def as_double(value: int) -> float | int:
    """The integer as a double if that is exact, otherwise unchanged."""
    return float(value) if -MAX_EXACT <= value <= MAX_EXACT else value


@dataclass(frozen=True, slots=True)
class Rewritten:
    """An expression after the pass; `origin[i]` is the offset of character i in the author's text."""

    text: str
    origin: tuple[int, ...]


def doubled(source: str, stems: Sequence[int] | None = None) -> Rewritten:
    """Rewrites `source` as described in the module's docstring. Never fails: CEL reports syntax errors.

    `stems` has the offsets of its characters in the author's text; None: `source` is the author's text.
    """
    scanned = list(tokens(source))
    significant = [token for token in scanned if token.kind not in (TokenKind.SPACE, TokenKind.COMMENT)]
    before, after, replaced = _edits(significant)
    text: list[str] = []
    origin: list[int] = []
    for token in scanned:
        own = replaced.get(token.start, token.text)
        text += (before.get(token.start, ""), own, after.get(token.start, ""))
        origin += [token.start] * len(text[-3])
        origin += range(token.start, token.end) if own == token.text else [token.start] * len(own)
        origin += [token.end - 1] * len(text[-1])
    return Rewritten("".join(text), tuple(origin) if stems is None else tuple(stems[at] for at in origin))


def _edits(line: list[Token]) -> tuple[dict[int, str], dict[int, str], dict[int, str]]:
    """Insertions before and after a token, and its replacement, by the start of the token."""
    matches = _matches(line)
    before: dict[int, str] = {}
    after: dict[int, str] = {}
    replaced: dict[int, str] = {}

    def wrap(first: int, last: int, function: str) -> None:
        start, end = line[first].start, line[last].start
        before[start] = before.get(start, "") + f"{function}("
        after[end] = ")" + after.get(end, "")

    for i, token in enumerate(line):
        is_method = i > 0 and line[i - 1].text == "."
        closing = matches[i + 1] if i + 1 in matches and line[i + 1].text == "(" else 0
        if token.kind is TokenKind.INT and not _stays_integer(line, matches, i, i):
            value = int(token.text, 0) if token.text.startswith("0x") else int(token.text)
            if value <= MAX_EXACT:
                replaced[token.start] = f"{value}.0"
        elif token.text == "[" and i in matches and _ends_operand(line, i - 1):
            if not _is_lone_literal(line, i + 1, matches[i]):
                wrap(i + 1, matches[i] - 1, "dyn")
        elif not closing:
            continue
        elif token.text in _COUNTING_METHODS and is_method:
            wrap(_operand_start(line, matches, i - 2), closing, "double")
        elif token.text == "size":
            wrap(i, closing, "double")
        elif token.text == "matches" and is_method and i > 1:
            wrap(_operand_start(line, matches, i - 2), i - 2, BOUNDED)
        elif token.text == "matches" and (comma := _first_comma(line, matches, i + 1)) > i + 2:
            wrap(i + 2, comma - 1, BOUNDED)
        elif token.text == "string" and not is_method and closing > i + 2:
            wrap(i + 2, closing - 1, DIGITS)
        elif token.text == "int" and not _stays_integer(line, matches, i, closing):
            wrap(i, closing, "double")
    return before, after, replaced


def _matches(line: list[Token]) -> dict[int, int]:
    """The partner of each bracket, both ways; brackets without one are left out."""
    result: dict[int, int] = {}
    pending: list[int] = []
    for i, token in enumerate(line):
        if token.kind is TokenKind.OPEN:
            pending.append(i)
        elif token.kind is TokenKind.CLOSE and pending and line[pending[-1]].text == _PAIRS[token.text]:
            partner = pending.pop()
            result[partner], result[i] = i, partner
    return result


def _first_comma(line: list[Token], matches: dict[int, int], opening: int) -> int:
    """The index of the comma after the first argument of a call; 0 if there is only one argument."""
    i = opening + 1
    while i < matches[opening]:
        if line[i].text == ",":
            return i
        i = matches.get(i, i) + 1
    return 0


def _stays_integer(line: list[Token], matches: dict[int, int], i: int, last: int) -> bool:
    """Whether the operand from token i to token `last` is at a place where CEL accepts only an integer."""
    previous, following = line[i - 1].text if i else "", line[last + 1].text if last + 1 < len(line) else ""
    if "%" in (previous, following):
        return True
    first = i - 1 if previous == "-" else i  # a sign belongs to the literal
    if first == 0 or first - 1 not in matches or matches[first - 1] != last + 1:
        return False
    opening = line[first - 1].text
    if opening == "[":
        return _ends_operand(line, first - 2)
    return opening == "(" and first > 1 and line[first - 2].text in ("timestamp", "string")


def _is_lone_literal(line: list[Token], first: int, end: int) -> bool:
    if end - first == 2 and line[first].text == "-":
        first += 1
    literals = (TokenKind.INT, TokenKind.UINT, TokenKind.FLOAT, TokenKind.STRING)
    return end == first or (end - first == 1 and line[first].kind in literals)


def _ends_operand(line: list[Token], i: int) -> bool:
    """Whether a bracket after token i is an index, not a list literal."""
    if i < 0:
        return False
    token = line[i]
    if token.kind is TokenKind.NAME:
        return token.text != "in" or (i > 0 and line[i - 1].text == ".")
    return token.kind in (TokenKind.STRING, TokenKind.CLOSE)


def _operand_start(line: list[Token], matches: dict[int, int], i: int) -> int:
    """The first token of the chain `a.b(c)[d]` whose last token is i."""
    while i >= 0:
        if line[i].kind is TokenKind.CLOSE and i in matches:
            i = matches[i]
            called = line[i].text == "(" and i > 0 and line[i - 1].kind is TokenKind.NAME and line[i - 1].text != "in"
            if called or (line[i].text in "[{" and _ends_operand(line, i - 1)):
                i -= 1
                if not called:
                    continue
        if i > 0 and line[i - 1].text == ".":
            if i == 1 or not _ends_operand(line, i - 2):
                return i - 1  # a leading dot, as in `.speed`
            i -= 2
            continue
        return i
    return 0
