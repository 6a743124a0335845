"""The functions that complement those of CEL, in one table, with units.

Each module of this package has functions of one kind, in plain Python. They raise ValueError for arguments without a
result; the expression is then unknown. `docs/rules.md` lists them for users, and a test compares the two.
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
"""The functions by name."""

OF_FIELDS: Final[Mapping[str, Function]] = MappingProxyType({each.name: each for each in position_fields.FUNCTIONS})
"""The internal functions behind the fields of `at` and `seenFrom` (see `expanding`), by name."""

DECLARATIONS: Final = [
    *preparing.DECLARATIONS,
    *(function.declaration() for function in (*FUNCTIONS.values(), *OF_FIELDS.values())),
]
"""The declarations for CEL."""

TAKING_HANDLES: Final = frozenset(name for name, function in FUNCTIONS.items() if function.takes_handles)
"""The functions that take lists, maps or bytes as handles."""
