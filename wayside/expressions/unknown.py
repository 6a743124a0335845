"""The third truth value: `UNKNOWN` is the result of an expression that is neither true nor false.

It has no truth value in Python: `if value:` raises for it, so no caller treats it as false by accident.
"""

from __future__ import annotations

import enum
from typing import Final, Self, final


@final
class Unknown:
    """The type of the one value `UNKNOWN`; compare with `is`."""

    _single: Self | None = None

    def __new__(cls) -> Self:
        """The one instance."""
        if cls._single is None:
            cls._single = super().__new__(cls)
        return cls._single

    def __bool__(self) -> bool:
        raise TypeError("unknown is neither true nor false: compare with `is UNKNOWN` first")

    def __repr__(self) -> str:
        return "unknown"

    def __reduce__(self) -> tuple[type[Unknown], tuple[()]]:
        return (Unknown, ())


UNKNOWN: Final = Unknown()


class Reason(enum.Enum):
    """The reason why an expression is unknown. Callers count the reasons separately."""

    ABSENT = "Absent"
    """An input is absent: a variable, key or index is missing, or a value is null or NaN."""
    ERROR = "Error"
    """The expression failed on existing inputs: a wrong type, a division by zero, too many iterations."""
