"""`detector replay --compare A B`: what two rules found in the same recording, as lines and as comparison.json."""

from __future__ import annotations

import json
from pathlib import Path

import typer

from detector.replay.comparing import compare
from detector.replay.replaying import Outcome
from wayside.commandline import refuse


def write_comparison(outcome: Outcome, rules: tuple[str, str], folder: Path) -> None:
    """Say how two rules compare, and write the whole of it. Refuses names that no rule has."""
    for rule in rules:
        if rule not in outcome.rules:
            refuse(f"--compare {rule}: there is no such rule; there are {', '.join(outcome.rules) or 'none'}")
    comparison = compare(outcome.events, *rules, outcome.end)
    (folder / "comparison.json").write_text(json.dumps(comparison.to_json(), indent=1) + "\n", encoding="utf-8")
    for line in comparison.lines():
        typer.echo(line, err=True)
