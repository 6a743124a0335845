"""The errors of expressions: one does not compile, fails on its values, or a field cannot be rendered."""

from __future__ import annotations

from typing import Self


class _LocatedError(Exception):
    """An error at a position in the author's text.

    `source` is the text, and `offset` the position in it; `line` and `column` count from 1, in characters. `path` is
    the path of the field, or empty. `hint` is the remedy, if one is known. `others` are further errors of the text.
    """

    def __init__(
        self, message: str, *, source: str = "", offset: int = 0, path: str = "", hint: str | None = None
    ) -> None:
        self.message = message
        self.source = source
        self.offset = offset
        self.line, self.column = position(source, offset)
        self.path = path
        self.hint = hint
        self.others: tuple[Self, ...] = ()
        super().__init__(message)

    def __str__(self) -> str:
        where = f"line {self.line}, column {self.column}"
        start = f"{self.path}, {where}" if self.path else where
        return f"{start}: {self.message} ({self.hint})" if self.hint else f"{start}: {self.message}"


class ExpressionError(_LocatedError):
    """The expression `source` does not compile."""


class EvaluationError(Exception):
    """An expression failed on the given values.

    `absent` distinguishes an absent value (a variable, map key or list index) from a fault of the expression.
    """

    def __init__(self, message: str, *, absent: bool = False) -> None:
        self.message = message
        self.absent = absent
        super().__init__(message)


class InterpolationError(_LocatedError):
    """The `${…}` of a field does not compile or cannot be rendered.

    `path` is the path of the field, such as `spec.manifests[0].spec.replicas`.
    """


def position(text: str, offset: int) -> tuple[int, int]:
    """Line and column, both from 1, of the character at `offset` of `text`."""
    line_start = text.rfind("\n", 0, offset) + 1
    return text.count("\n", 0, offset) + 1, offset - line_start + 1
