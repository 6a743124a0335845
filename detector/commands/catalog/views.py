"""The views of a catalog: Markdown, JSON for other programs, a table for a terminal, and a self-contained HTML page.

The page has a chart with a row for each dimension and a cell for each value, after the paper's Figure 1; the tables of
rules are like its Tables 2 to 7. Selecting values filters the rules: a rule must have a selected value in each
dimension with a selection. Without scripts the page still shows everything.
"""

from __future__ import annotations

import colorsys
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from html import escape
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from detector.commands.catalog.catalog import Catalog, CatalogEntry
from wayside.api.classification import SCHEME, CharacteristicValue, Dimension

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


def page(catalog: Catalog) -> str:
    """The whole page."""
    numbers = {each: f"rule-{index}" for index, each in enumerate(catalog.entries)}
    body = [*_chart(catalog, numbers), *_tables(catalog, numbers)]
    return _PAGE.format(style=_STYLE, script=_SCRIPT, count=len(catalog.entries), body="\n".join(body))


def _chart(catalog: Catalog, numbers: Mapping[CatalogEntry, str]) -> Iterator[str]:
    labels = catalog.labels()
    yield '<section class="chart">'
    for index, dimension in enumerate(SCHEME):
        yield f'<div class="dimension" style="--hue: {_hue(index)}">'
        yield f'<h2 title="{escape(dimension.definition)}">{escape(dimension.words)}</h2><div class="values">'
        for value in dimension.values:
            rules = "".join(
                f'<li data-rule="{numbers[each]}"><a href="#{numbers[each]}">{escape(labels[each])}</a></li>'
                for each in catalog.having(value)
            )
            yield (
                f'<div class="value"><button type="button" aria-pressed="false" data-value="{_key(dimension, value)}" '
                f'title="{escape(value.definition)}">{escape(value.words)}</button><ul>{rules}</ul></div>'
            )
        yield "</div></div>"
    yield "</section>"


def _tables(catalog: Catalog, numbers: Mapping[CatalogEntry, str]) -> Iterator[str]:
    labels = catalog.labels()
    yield '<section class="rules">'
    for each in catalog.entries:
        keys = " ".join(_key(dimension, value) for dimension in SCHEME for value in each.values(dimension))
        yield f'<article id="{numbers[each]}" data-rule="{numbers[each]}" data-values="{keys}">'
        yield f"<h2>{escape(labels[each])}</h2><p>{escape(each.description)}</p>"
        yield f'<p class="place">{escape(each.place)}</p>'
        if each.classified:
            yield f"<table><tbody>{''.join(_rows(each))}</tbody></table>"
        else:
            yield "<p>It has no classification.</p>"
        yield "</article>"
    yield "</section>"


def _rows(each: CatalogEntry) -> Iterator[str]:
    for dimension in SCHEME:
        values = ", ".join(
            f'<span title="{escape(value.definition)}">{escape(value.words)}</span>' for value in each.values(dimension)
        )
        yield f"<tr><th>{escape(dimension.words)}</th><td>{values or '–'}</td></tr>"


def _key(dimension: Dimension, value: CharacteristicValue) -> str:
    return f"{dimension.name}.{value.value}"


def _hue(index: int) -> str:
    """A distinct colour for each dimension, all equally bright."""
    red, green, blue = colorsys.hls_to_rgb(index / len(SCHEME), 0.42, 0.55)
    return f"rgb({red * 255:.0f} {green * 255:.0f} {blue * 255:.0f})"


_STYLE = """
:root { color-scheme: light dark; font: 15px/1.45 system-ui, sans-serif; }
body { max-width: 76rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1rem; margin: 0; } a { color: inherit; }
.dimension { display: grid; grid-template-columns: 13rem 1fr; gap: .5rem; margin: .4rem 0; }
.dimension > h2 { background: var(--hue); color: white; padding: .45rem .6rem; border-radius: .3rem; }
.values { display: grid; grid-auto-flow: column; grid-auto-columns: 1fr; gap: .5rem; }
.value { border: 1px solid var(--hue); border-radius: .3rem; overflow-wrap: anywhere; }
.value button { font: inherit; width: 100%; text-align: left; border: 0; padding: .45rem .6rem; cursor: pointer;
  background: color-mix(in srgb, var(--hue) 18%, transparent); color: inherit; }
.value button[aria-pressed=true] { background: var(--hue); color: white; }
.value ul { list-style: none; margin: 0; padding: 0 .6rem; font-size: .8rem; }
.rules { display: grid; grid-template-columns: repeat(auto-fill, minmax(22rem, 1fr)); gap: 1rem; margin-top: 2rem; }
article { border: 1px solid #8886; border-radius: .3rem; padding: .8rem; break-inside: avoid; overflow-wrap: anywhere; }
article p { margin: .2rem 0; } .place { font-size: .75rem; opacity: .7; }
table { border-collapse: collapse; width: 100%; font-size: .85rem; }
th, td { border-top: 1px solid #8884; padding: .2rem .3rem; }
th, td { text-align: left; font-weight: normal; vertical-align: top; }
th { width: 50%; opacity: .8; } [hidden] { display: none; }
@media (max-width: 50rem) { .dimension { grid-template-columns: 1fr; } .values { grid-auto-flow: row; } }
"""

_SCRIPT = """
const chosen = new Map();
const articles = [...document.querySelectorAll("article")];
const links = [...document.querySelectorAll("li[data-rule]")];
function show() {
  const left = new Set(articles.filter((each) => {
    const has = new Set(each.dataset.values.split(" "));
    return [...chosen.values()].every((values) => values.size === 0 || [...values].some((value) => has.has(value)));
  }).map((each) => each.dataset.rule));
  for (const each of [...articles, ...links]) each.hidden = !left.has(each.dataset.rule);
  document.getElementById("count").textContent = left.size;
}
for (const button of document.querySelectorAll("button[data-value]")) button.addEventListener("click", () => {
  const dimension = button.dataset.value.split(".")[0];
  const values = chosen.get(dimension) ?? new Set();
  chosen.set(dimension, values);
  if (!values.delete(button.dataset.value)) values.add(button.dataset.value);
  button.setAttribute("aria-pressed", values.has(button.dataset.value));
  show();
});
"""

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Rules by dimension and value</title>
<style>{style}</style>
</head>
<body>
<h1>Rules by dimension and value</h1>
<p><span id="count">{count}</span> of {count} rules. Press values to see only the rules that have them; their
definitions show under the pointer.</p>
{body}
<script>{script}</script>
</body>
</html>
"""
