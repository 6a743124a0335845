"""The views of a catalog: Markdown, JSON for other programs, and a table for a terminal."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from detector.commands.catalog.catalog import Catalog, CatalogEntry
from wayside.api.classification import SCHEME

_MEANINGFUL = re.compile(r"([\\`*_{}\[\]<>()#+!|~])")


def markdown_view(catalog: Catalog) -> str:
    """One table of all values, then one per rule, like the paper's tables of use cases."""
    return "\n".join([*_overview(catalog), *_rules(catalog)]) + "\n"


def _overview(catalog: Catalog) -> Iterator[str]:
    labels = catalog.labels()

    def names(entries: Iterable[CatalogEntry]) -> str:
        return ", ".join(_text(labels[each]) for each in entries)

    yield from ("# Rules by dimension and value", "", "| dimension | value | rules |", "|---|---|---|")
    for dimension in SCHEME:
        first = f"**{dimension.words}**"
        for value in dimension.values:
            yield f"| {first} | {value.words} | {names(catalog.having(value))} |"
            first = ""
        if silent := catalog.silent(dimension):
            yield f"| | *not given* | {names(silent)} |"
    if catalog.unclassified:
        yield from ("", f"Without classification: {names(catalog.unclassified)}.")


def _rules(catalog: Catalog) -> Iterator[str]:
    labels = catalog.labels()
    for each in catalog.entries:
        if not each.classified:
            continue
        yield from ("", f"## {_text(labels[each])}", "")
        if each.description:
            yield from (_text(each.description), "")
        yield from ("| dimension | value |", "|---|---|")
        for dimension in SCHEME:
            if values := each.values(dimension):
                yield f"| {dimension.words} | {', '.join(value.words for value in values)} |"


def _text(text: str) -> str:
    """The text escaped for Markdown, on one line."""
    return _MEANINGFUL.sub(r"\\\1", " ".join(text.split()))


def json_view(catalog: Catalog) -> str:
    """One object: `dimensions` and `rules`. The `rules` of a value are indices into the list of all rules."""
    place = {each: index for index, each in enumerate(catalog.entries)}
    document = {
        "dimensions": [
            {
                "name": dimension.name,
                "words": dimension.words,
                "definition": dimension.definition,
                "values": [
                    {
                        "name": value.value,
                        "words": value.words,
                        "definition": value.definition,
                        "rules": [place[each] for each in catalog.having(value)],
                    }
                    for value in dimension.values
                ],
            }
            for dimension in SCHEME
        ],
        "rules": [_rule(each) for each in catalog.entries],
    }
    return json.dumps(document, ensure_ascii=False, indent=2) + "\n"


def _rule(each: CatalogEntry) -> dict[str, Any]:
    fields = {"name": each.name, "place": each.place, "description": each.description or None}
    classification = each.classification.to_json() if each.classified else None
    return {name: value for name, value in (*fields.items(), ("classification", classification)) if value is not None}


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
