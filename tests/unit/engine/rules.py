"""The rules of the engine's tests: one over single clients, one over pairs; and what their episodes demand."""

from __future__ import annotations

from typing import Any

from tests.driving import POSITION, SPEED, Drive, a_rule, compiled


def speeding(name: str = "r", **spec: Any) -> Any:
    return a_rule(name, **{"signals": [SPEED], "when": "speed > 10", **spec})


def near(name: str = "near", **spec: Any) -> Any:
    return a_rule(
        name,
        **{
            "scope": {"pairs": {"position": POSITION, "within": 250}},
            "when": "distance < 150",
            "until": "distance > 200",
            **spec,
        },
    )


def demanded(drive: Drive) -> dict[str, Any]:
    """The demands by action."""
    return {demand.action: (demand.template, demand.parameters) for demand in drive.engine.demands().values()}


def change(drive: Drive, *rules: Any) -> list[str]:
    return drive.note(drive.engine.set_rules(compiled(drive.detector, *rules)))
