"""Which results there are."""

from __future__ import annotations

from enum import StrEnum


class Kind(StrEnum):
    """What `detector replay --results` writes."""

    REPORT = "report"
    """report.html."""
    MCAP = "mcap"
    """results.mcap, and layout.json for Foxglove."""
    EPISODES = "episodes"
    """episodes.parquet and episodes.csv."""
    ALL = "all"


def chosen(kinds: list[Kind] | None) -> frozenset[Kind]:
    """All kinds that are meant, without ALL."""
    each = frozenset(Kind) - {Kind.ALL}
    return each if kinds and Kind.ALL in kinds else frozenset(kinds or ())
