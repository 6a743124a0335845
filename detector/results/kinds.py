"""The kinds of results, and whether the packages that they need are installed."""

from __future__ import annotations

from enum import StrEnum
from importlib.util import find_spec

from wayside.inputerror import InputError


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


class MissingExtraError(InputError, RuntimeError):
    """A result needs a package that is not installed."""


def check_package(package: str, option: str, extra: str = "results") -> None:
    """Raises MissingExtraError if the package that the option needs is missing."""
    if find_spec(package) is None:
        raise MissingExtraError(f"{option} needs {package}: pip install 'wayside[{extra}]'")
