"""Values with fields: replaces each field that an expression reads of such a value by a call with numbers.

    at(a.position, "crossing").inside  →  (at_inside((a.position).x, (a.position).y, r'crossing#…') > 0.0)
    seenFrom(a, b).ahead               →  seen_ahead((a).position.x, (a).position.y, (a).yaw, …)
    position.x                         →  (msg.pose.position.x), as the stream's `position` has it
    positionBefore.x                   →  (before.pose.position.x), that of the sample before

So CEL and columns read only plain paths and numbers, and a field does not compute the inputs of another one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple, NoReturn

from wayside.expressions.errors import ExpressionError
from wayside.expressions.lexer import TokenKind, tokens
from wayside.geo.geometry import Shape
from wayside.names import did_you_mean

AT: Final = "at"
SEEN_FROM: Final = "seenFrom"
POSITION: Final = "position"
POSITION_BEFORE: Final = "positionBefore"
_POSITIONS: Final = (POSITION, POSITION_BEFORE)
_BEFORE: Final = "before"
_OF_A_SAMPLE: Final = frozenset({"msg", "item", "sample"})
AXES: Final = {False: ("x", "y", "yaw"), True: ("latitude", "longitude", "heading")}
"""The axes of a position in metres (False) and on the Earth (True): two coordinates and a direction."""
FIELDS_AT: Final = {
    "inside": "whether the position is inside the area or lane, or on its edge",
    "distance": "metres to the place; 0 inside",
    "along": "metres along the line or lane; negative before its start, greater than its length beyond its end",
    "across": "metres to the left of the line or of the middle of the lane; negative to the right",
    "heading": "the direction of the position relative to the line, degrees in (-180, 180]; positive to the left",
}
FIELDS_SEEN: Final = {
    "ahead": "metres to b along the direction of a; negative behind",
    "left": "metres to b across the direction of a, to the left; negative to the right",
    "speedAhead": "the velocity of b minus that of a, along the direction of a, m/s; negative if b falls back",
    "speedLeft": "the velocity of b minus that of a, to the left of a, m/s",
    "heading": "the direction of b relative to that of a, degrees in (-180, 180]; positive to the left",
}


@dataclass(frozen=True)
class NamedPlaces:
    """The places that expressions can name, and the source of the positions."""

    shapes: Mapping[str, Shape] = field(default_factory=dict)
    known: bool = True
    """Whether the places are complete. If not, any name compiles, and the compiled expression must not be evaluated."""
    geographic: bool | None = None
    """Whether the positions of a pair are on the Earth; None: the expression is not about pairs."""
    position: Mapping[str, str] | None = None
    """The expressions of the stream's position by axis; None: the expression is not over samples."""
    stream: str = ""
    """The stream's name, for errors."""
    own: str = "msg"
    """The variable of the client's message, or of its item."""


class Expanded(NamedTuple):
    """The new text, the offset of each of its characters in the author's text, and the shapes that it names."""

    text: str
    origin: tuple[int, ...]
    shapes: tuple[Shape, ...]


def expanded(source: str, places: NamedPlaces) -> Expanded:
    """Rewrites `source`. Raises ExpressionError, with a position in `source`, for an unknown place or field."""
    return _Expansion(source, places).expanded()


class _Piece(NamedTuple):
    text: str
    origin: tuple[int, ...]


class _Expansion:
    def __init__(self, source: str, places: NamedPlaces) -> None:
        self._source = source
        self._places = places
        self._tokens = [
            each for each in tokens(source) if each.kind not in (TokenKind.SPACE, TokenKind.COMMENT)
        ]  # fmt: skip
        self._shapes: dict[str, Shape] = {}

    def expanded(self) -> Expanded:
        pieces = list(self._range(0, len(self._tokens), 0, len(self._source)))
        text = "".join(piece.text for piece in pieces)
        return Expanded(text, tuple(at for piece in pieces for at in piece.origin), tuple(self._shapes.values()))

    def _range(self, first: int, last: int, begin: int, end: int) -> Iterator[_Piece]:
        """The tokens from index `first` to `last`, between the offsets `begin` and `end`, expanded."""
        at, done = first, begin
        while at < last:
            token, after = self._tokens[at], at + 1
            called = self._text(at + 1) == "(" and self._text(at - 1) != "."
            replacement: str | None = None
            if token.text in (AT, SEEN_FROM) and called:
                replacement, after = self._call(at, last)
            elif token.text in _POSITIONS and self._places.position is not None and self._text(at - 1) != ".":
                replacement, after = self._position(at, last)
            if replacement is not None:
                yield _Piece(self._source[done : token.start], tuple(range(done, token.start)))
                yield _Piece(replacement, (token.start,) * len(replacement))
                done = self._tokens[after - 1].end
            at = after
        yield _Piece(self._source[done:end], tuple(range(done, end)))

    def _call(self, at: int, last: int) -> tuple[str, int]:
        """The replacement of a call of `at` or `seenFrom` with its field, and the index of the token after it."""
        name = self._tokens[at].text
        arguments, after = self._arguments(at + 1, last)
        usage = f'{AT}(position, "place")' if name == AT else f"{SEEN_FROM}(a, b)"
        fields = FIELDS_AT if name == AT else FIELDS_SEEN
        if len(arguments) != 2:
            self._refuse(at, f"wrong number of arguments for `{name}`", f"write {usage}.{next(iter(fields))}")
        if self._text(after) != "." or after + 1 >= last or self._tokens[after + 1].kind is not TokenKind.NAME:
            self._refuse(at, f"`{name}` needs a field", f"write {usage}.{next(iter(fields))}")
        chosen = self._text(after + 1)
        if chosen not in fields:
            self._refuse(
                after + 1,
                f"{name} has no field {chosen}",
                did_you_mean(chosen, fields) or f"it has {', '.join(fields)}",
            )
        if name == SEEN_FROM:
            return self._seen(at, chosen, *map(self._inner, arguments)), after + 2
        return self._at(at, chosen, arguments), after + 2

    def _at(self, at: int, chosen: str, arguments: Sequence[tuple[int, int]]) -> str:
        (first, last) = arguments[1]
        given = self._tokens[first]
        if last - first != 1 or given.kind is not TokenKind.STRING or given.text[0] not in "\"'":
            self._refuse(first, "the name of a place must be a string in quotes", 'write it out, as in "crossing"')
        name = given.text[1:-1]
        shape = self._places.shapes.get(name)
        if shape is None:
            if not self._places.known:
                return "(0.0 > 1.0)" if chosen == "inside" else "(0.0 + 0.0)"
            known = f"there are {', '.join(self._places.shapes)}" if self._places.shapes else "the Detector has none"
            self._refuse(first, f"there is no place {name}", did_you_mean(name, self._places.shapes) or known)
        if chosen not in shape.fields:
            what = "an area" if shape.rings else "a line without width"
            self._refuse(at, f"{name} is {what}, which has no {chosen}", f"it has {', '.join(shape.fields)}")
        if chosen == "heading" and self._places.geographic is not None and self._text(arguments[0][1] - 1) == POSITION:
            self._refuse(
                at,
                "the position of a pair has no direction",
                f'use a signal over the stream, with the value at(position, "{name}").heading',
            )
        self._shapes[name] = shape
        u, v, heading = (self._axis(arguments[0], axis, shape) for axis in AXES[shape.geographic])
        place = f"r'{shape.key}'"
        if chosen == "heading":
            direction = f"90.0 - {heading()}" if shape.geographic else f"degrees({heading()})"
            return f"at_heading({u()}, {v()}, {direction}, {place})"
        call = f"at_{chosen}({u()}, {v()}, {place})"
        return f"({call} > 0.0)" if chosen == "inside" else call

    def _axis(self, argument: tuple[int, int], axis: str, shape: Shape) -> Callable[[], str]:
        """Returns a function that writes an axis of the position, to be called only if the axis is needed."""
        first, last = argument
        if last - first == 1 and self._text(first) in _POSITIONS and self._places.position is not None:
            of = f"place {shape.name} is in {'degrees' if shape.geographic else 'metres'}"
            return lambda: self._of_stream(first, axis, of)
        return lambda: f"({self._inner(argument)}).{axis}"

    def _seen(self, at: int, chosen: str, a: str, b: str) -> str:
        if self._places.geographic is None:
            self._refuse(at, f"`{SEEN_FROM}` needs two clients", "use it in a rule with scope pairs")
        if not self._places.known:
            return "(0.0 + 0.0)"
        first, second, heading = AXES[self._places.geographic]
        yaws = [f"radians(90.0 - ({each}).{heading})" if heading == "heading" else f"({each}).yaw" for each in (a, b)]
        if chosen == "heading":
            return f"seen_heading({yaws[0]}, {yaws[1]})"
        if chosen.startswith("speed"):
            return f"seen_{chosen}({yaws[0]}, ({a}).speed, {yaws[1]}, ({b}).speed)"
        suffix = "Wgs84" if self._places.geographic else ""
        places = [f"({each}).position.{first}, ({each}).position.{second}" for each in (a, b)]
        return f"seen_{chosen}{suffix}({places[0]}, {yaws[0]}, {places[1]})"

    def _position(self, at: int, last: int) -> tuple[str, int]:
        if at + 2 < last and self._text(at + 1) == "." and self._tokens[at + 2].kind is TokenKind.NAME:
            return self._of_stream(at, self._text(at + 2), ""), at + 3
        self._of_stream(at, "", "")
        pairs = (f'"{axis}": {self._of_stream(at, axis, "")}' for axis in self._places.position or {})
        return f"{{{', '.join(pairs)}}}", at + 1

    def _of_stream(self, at: int, axis: str, why: str) -> str:
        """The stream's expression for an axis. With an empty axis, it only checks that there is a position."""
        given = self._places.position or {}
        if not given and not self._places.known:
            return "(0.0 + 0.0)"
        if not given:
            self._refuse(
                at, f"stream {self._places.stream} has no position", "set position in this stream of the Detector"
            )
        if axis and axis not in given:
            because = f"; {why}" if why else ""
            self._refuse(
                at, f"the position of stream {self._places.stream} has no {axis}{because}", f"it has {', '.join(given)}"
            )
        if not axis:
            return ""
        return f"({given[axis] if self._text(at) == POSITION else self._before(at, given[axis])})"

    def _before(self, at: int, source: str) -> str:
        """The expression of the stream's position, over the previous message or item."""
        found: list[str] = []
        last = ""
        for token in tokens(source):
            name = token.text if token.kind is TokenKind.NAME and last != "." else ""
            if name in _OF_A_SAMPLE and name != self._places.own:
                self._refuse(
                    at,
                    f"{POSITION_BEFORE} of stream {self._places.stream} is unknown, because its position reads {name}",
                    f"use only {self._places.own} in the position",
                )
            found.append(_BEFORE if name == self._places.own else token.text)
            last = last if token.kind is TokenKind.SPACE else token.text
        return "".join(found)

    def _arguments(self, opening: int, last: int) -> tuple[list[tuple[int, int]], int]:
        """The arguments of a call as ranges of tokens, and the index of the token after its closing bracket."""
        found: list[tuple[int, int]] = []
        depth, begin = 0, opening + 1
        for at in range(opening, last):
            token = self._tokens[at]
            depth += {TokenKind.OPEN: 1, TokenKind.CLOSE: -1}.get(token.kind, 0)
            if (token.text == "," and depth == 1) or depth == 0:
                if at > begin or found:
                    found.append((begin, at))
                begin = at + 1
            if depth == 0:
                return found, at + 1
        return found, last

    def _inner(self, argument: tuple[int, int]) -> str:
        first, last = argument
        if first == last:
            return ""
        begin, end = self._tokens[first].start, self._tokens[last - 1].end
        return "".join(piece.text for piece in self._range(first, last, begin, end))

    def _text(self, at: int) -> str:
        return self._tokens[at].text if 0 <= at < len(self._tokens) else ""

    def _refuse(self, at: int, message: str, hint: str) -> NoReturn:
        raise ExpressionError(message, source=self._source, offset=self._tokens[at].start, hint=hint)
