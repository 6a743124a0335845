"""The kinds of results."""

from __future__ import annotations

from enum import StrEnum


class ResultKind(StrEnum):
    """The options of `detector replay --results`."""

    REPORT = "report"
    """report.html."""
    MCAP = "mcap"
    """results.mcap, and layout.json for Foxglove."""
    EPISODES = "episodes"
    """episodes.parquet and episodes.csv."""
    ALL = "all"


def chosen(kinds: list[ResultKind] | None) -> frozenset[ResultKind]:
    """The selected kinds, with ALL expanded."""
    each = frozenset(ResultKind) - {ResultKind.ALL}
    return each if kinds and ResultKind.ALL in kinds else frozenset(kinds or ())
