"""The catalog as Markdown: one table of all values, then one per rule, like the paper's tables of use cases."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from detector.commands.catalog.catalog import Catalog, CatalogEntry
from wayside.api.scheme import SCHEME

_MEANINGFUL = re.compile(r"([\\`*_{}\[\]<>()#+!|~])")


def markdown_view(catalog: Catalog) -> str:
    """The whole page."""
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
