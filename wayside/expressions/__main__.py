"""`python -m wayside.expressions [FOLDER]`: write the tables of functions and fields into the pages (default: docs)."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from wayside.expressions.expanding import FIELDS_AT, FIELDS_SEEN
from wayside.expressions.functions import FUNCTIONS
from wayside.geo.geometry import Shape

_POINTS: Final = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0))
_KINDS: Final[Mapping[str, Shape]] = {
    "areas": Shape("area", False, rings=(_POINTS,)),
    "lines": Shape("line", False, line=_POINTS),
    "lanes": Shape("lane", False, line=_POINTS, width=1.0),
}
"""A place of each kind."""


def tables() -> dict[str, dict[str, str]]:
    """By page and heading of its first column, the table."""
    functions = {function.usage().replace(" or ", "`, `"): (function.summary,) for function in FUNCTIONS.values()}
    of_places = {field: (_kinds_with(field), text) for field, text in FIELDS_AT.items()}
    seen = {field: (text,) for field, text in FIELDS_SEEN.items()}
    return {
        "rules.md": {"function": _table(("function", "value"), functions)},
        "places.md": {
            "field of at": _table(("field of at", "of", "value"), of_places),
            "field of seenFrom": _table(("field of seenFrom", "value"), seen),
        },
    }


def with_tables(page: str, of_page: Mapping[str, str]) -> str:
    """The page with its tables. Raises ValueError for a table that is not in it."""
    for heading, table in of_page.items():
        before, found, rest = page.partition(f"\n| {heading} |")
        if not found:
            raise ValueError(f"there is no table with the first column {heading}: add its first line to the page")
        lines = rest.split("\n")
        after = next((at for at, line in enumerate(lines) if at and not line.startswith("|")), len(lines))
        page = "\n".join([before, table, *lines[after:]])
    return page


def main() -> None:
    """Write the pages."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "docs")
    for name, of_page in tables().items():
        path = folder / name
        path.write_text(with_tables(path.read_text(encoding="utf-8"), of_page), encoding="utf-8")


def _kinds_with(field: str) -> str:
    kinds = [name for name, shape in _KINDS.items() if field in shape.fields]
    return "all" if len(kinds) == len(_KINDS) else ", ".join(kinds)


def _table(heading: tuple[str, ...], rows: Mapping[str, tuple[str, ...]]) -> str:
    lines = [heading, ("---",) * len(heading), *((f"`{name}`", *rest) for name, rest in rows.items())]
    return "\n".join("|---" * len(line) + "|" if line[0] == "---" else f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    main()
