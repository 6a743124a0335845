"""The catalog for a terminal: a table of dimensions, values and rules."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from detector.commands.catalog.catalog import Catalog, CatalogEntry
from wayside.api.scheme import SCHEME


def terminal_view(catalog: Catalog) -> RenderableType:
    """Each value of each dimension with the rules that have it."""
    labels = catalog.labels()

    def names(entries: Iterable[CatalogEntry]) -> Text:
        return Text(", ".join(labels[each] for each in entries))

    table = Table(box=None, pad_edge=False, show_edge=False)
    for column in ("DIMENSION", "VALUE", "RULES"):
        table.add_column(column, no_wrap=column != "RULES")
    for dimension in SCHEME:
        first = dimension.words
        for value in dimension.values:
            table.add_row(first, value.words, names(catalog.having(value)))
            first = ""
        if silent := catalog.silent(dimension):
            table.add_row(first, "(not given)", names(silent))
    if not catalog.unclassified:
        return table
    return Group(table, Text.assemble("\nwithout classification: ", names(catalog.unclassified)))
