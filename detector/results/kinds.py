"""The kinds of results."""

from __future__ import annotations

from enum import StrEnum


class Kind(StrEnum):
    """The options of `detector replay --results`."""

    REPORT = "report"
    """report.html."""
    MCAP = "mcap"
    """results.mcap, and layout.json for Foxglove."""
    EPISODES = "episodes"
    """episodes.parquet and episodes.csv."""
    ALL = "all"


def chosen(kinds: list[Kind] | None) -> frozenset[Kind]:
    """The selected kinds, with ALL expanded."""
    each = frozenset(Kind) - {Kind.ALL}
    return each if kinds and Kind.ALL in kinds else frozenset(kinds or ())
