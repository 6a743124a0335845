"""`detector replay --compare A B`: what two rules found in the same recording, as lines and as comparison.json."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import typer

from detector.replay.comparing import compare, joined
from detector.replay.replaying import Outcome
from wayside.commandline import refuse


def write_comparison(outcomes: Sequence[Outcome], rules: tuple[str, str], folder: Path) -> None:
    """Say how two rules compare over all recordings, and write the whole of it. Refuses names that no rule has."""
    known = sorted({rule for outcome in outcomes for rule in outcome.rules})
    for rule in rules:
        if rule not in known:
            refuse(f"--compare {rule}: there is no such rule; there are {', '.join(known) or 'none'}")
    comparison = joined([compare(outcome.events, *rules, outcome.end) for outcome in outcomes])
    (folder / "comparison.json").write_text(json.dumps(comparison.to_json(), indent=1) + "\n", encoding="utf-8")
    for line in comparison.lines():
        typer.echo(line, err=True)
