"""Which results there are."""

from __future__ import annotations

from enum import StrEnum


class ResultKind(StrEnum):
    """What `detector replay --results` writes."""

    REPORT = "report"
    """report.html."""
    MCAP = "mcap"
    """results.mcap, and layout.json for Foxglove."""
    EPISODES = "episodes"
    """episodes.parquet and episodes.csv."""
    ALL = "all"


def chosen(kinds: list[ResultKind] | None) -> frozenset[ResultKind]:
    """All kinds that are meant, without ALL."""
    each = frozenset(ResultKind) - {ResultKind.ALL}
    return each if kinds and ResultKind.ALL in kinds else frozenset(kinds or ())
