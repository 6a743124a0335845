"""The errors of expressions: it does not compile, it fails on its values, or a field cannot be rendered."""

from __future__ import annotations

from typing import Self


class ExpressionError(Exception):
    """An expression that does not compile.

    `line` and `column` count from 1, in characters of the author's own text. `hint` is the remedy where one is known.
    `others` holds the further errors of the same expression.
    """

    def __init__(
        self,
        message: str,
        *,
        source: str,
        line: int = 1,
        column: int = 1,
        hint: str | None = None,
        others: tuple[Self, ...] = (),
    ) -> None:
        self.message = message
        self.source = source
        self.line = line
        self.column = column
        self.hint = hint
        self.others = others
        super().__init__(message)

    def __str__(self) -> str:
        return _located("", self.line, self.column, self.message, self.hint)


class EvaluationError(Exception):
    """An expression that failed on the values it was given.

    `absent` distinguishes an absent value (a variable, map key or list index) from a fault of the expression.
    """

    def __init__(self, message: str, *, absent: bool = False) -> None:
        self.message = message
        self.absent = absent
        super().__init__(message)


class InterpolationError(Exception):
    """A field whose `${…}` does not compile or cannot be rendered.

    `path` is the field's, such as `spec.manifests[0].spec.replicas`; `line` and `column` count from 1 inside the
    field's text. `others` holds the further errors of the same template.
    """

    def __init__(
        self,
        message: str,
        *,
        path: str,
        line: int = 1,
        column: int = 1,
        hint: str | None = None,
        others: tuple[Self, ...] = (),
    ) -> None:
        self.message = message
        self.path = path
        self.line = line
        self.column = column
        self.hint = hint
        self.others = others
        super().__init__(message)

    def __str__(self) -> str:
        return _located(self.path, self.line, self.column, self.message, self.hint)


def _located(path: str, line: int, column: int, message: str, hint: str | None) -> str:
    where = f"line {line}, column {column}"
    start = f"{path}, {where}" if path else where
    return f"{start}: {message} ({hint})" if hint else f"{start}: {message}"


def position(text: str, offset: int) -> tuple[int, int]:
    """Line and column, both from 1, of the character at `offset` of `text`."""
    line_start = text.rfind("\n", 0, offset) + 1
    return text.count("\n", 0, offset) + 1, offset - line_start + 1
