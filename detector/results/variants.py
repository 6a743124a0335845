"""The comparison of variants of rules with the rules as written: a table, and variants.json."""

from __future__ import annotations

import json
import statistics
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from detector.replay.comparing import Comparison, combined, compare
from detector.replay.replaying import Replayed
from detector.replay.variants import Variant


def comparisons(outcomes: Sequence[Replayed], variants: Sequence[Variant]) -> list[Comparison]:
    """Each variant with its rule as written, over all recordings."""
    return [
        combined([compare(outcome.events, each.of, each.rule.name, outcome.end) for outcome in outcomes])
        for each in variants
    ]


def write_variants(path: Path, variants: Sequence[Variant], found: Sequence[Comparison]) -> None:
    """Write which episodes each variant shares with its rule, adds and loses."""
    documents = [
        {"rule": each.of, "variant": each.label, **comparison.to_json()}
        for each, comparison in zip(variants, found, strict=True)
    ]
    path.write_text(json.dumps(documents, indent=1) + "\n", encoding="utf-8")


def show_variants(console: Console, variants: Sequence[Variant], found: Sequence[Comparison]) -> None:
    """Print a table: the rule as written first, then its variants."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in ("rule", "variant"):
        table.add_column(name, overflow="fold")
    for name in ("episodes", "same", "gained", "lost", "start", "agreement"):
        table.add_column(name, justify="right")
    before = None
    for each, comparison in zip(variants, found, strict=True):
        if each.of != before:
            before = each.of
            table.add_row(escape(each.of), "as written", str(len(comparison.both) + len(comparison.only_first)))
        later = comparison.start_differences
        agreement = comparison.agreement
        table.add_row(
            "",
            escape(each.label),
            str(len(comparison.both) + len(comparison.only_second)),
            str(len(comparison.both)),
            f"+{len(comparison.only_second)}",
            f"-{len(comparison.only_first)}",
            f"{statistics.median(later):+.2f} s" if later else "",
            "" if agreement is None else f"{agreement:.1%}",
        )
    console.print(table, highlight=False)
