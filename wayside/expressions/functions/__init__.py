"""The functions that complement CEL's own: one table of all, with units.

Each module of this package holds functions of one kind, as plain Python that raises ValueError for arguments that have
no answer; the evaluation is unknown then. `docs/rules.md` lists them for users, and a test compares the two.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from wayside.expressions.functions import (
    angles,
    comparing,
    motion,
    numbers,
    octets,
    places,
    position_fields,
    preparing,
)
from wayside.expressions.functions.declaring import Function

FUNCTIONS: Final[Mapping[str, Function]] = MappingProxyType(
    {
        function.name: function
        for module in (numbers, angles, places, motion, comparing, octets)
        for function in module.FUNCTIONS
    }
)
"""By name."""

OF_FIELDS: Final[Mapping[str, Function]] = MappingProxyType({each.name: each for each in position_fields.FUNCTIONS})
"""Not for authors: the functions that fields of `at` and `seenFrom` become (see `expanding`)."""

DECLARATIONS: Final = [
    *preparing.DECLARATIONS,
    *(function.declaration() for function in (*FUNCTIONS.values(), *OF_FIELDS.values())),
]
"""As CEL takes them."""

TAKING_HANDLES: Final = frozenset(name for name, function in FUNCTIONS.items() if function.takes_handles)
"""The functions that take lists, maps or bytes, unread."""
