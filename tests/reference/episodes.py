"""The episodes of one subject, from its whole history."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Truth = bool | None
"""None is unknown."""


@dataclass(frozen=True)
class Observation:
    """The verdicts of the rule for the subject at a tick."""

    time: int
    condition: Truth
    """Whether an episode may start."""
    in_scope: Truth
    until: Truth


@dataclass(frozen=True)
class Break:
    """A client of the subject is lost, or (not `lost`) there was a gap: what was pending is forgotten."""

    time: int
    lost: bool


@dataclass
class Episode:
    """Times are nanoseconds; `end` is None while it is open."""

    onset: int
    start: int
    end: int | None = None
    reason: str = ""


def episodes(history: list[Observation | Break], hold: int, cooldown: int, unknown_timeout: int) -> list[Episode]:
    """All episodes, the last of which may be open."""
    found: list[Episode] = []
    first = 0
    rests_until = 0
    while True:
        start = next(
            (
                index
                for index in range(first, len(history))
                if _onset(history[first : index + 1], hold, rests_until) is not None
            ),
            None,
        )
        if start is None:
            return found
        onset = _onset(history[first : start + 1], hold, rests_until)
        assert onset is not None
        episode = Episode(onset, history[start].time)
        found.append(episode)
        for index in range(start + 1, len(history)):
            reason = _end(history[start + 1 : index + 1], unknown_timeout)
            if reason:
                episode.end, episode.reason = history[index].time, reason
                first, rests_until = index + 1, history[index].time + cooldown
                break
        else:
            return found


def wakes(history: list[Observation | Break], hold: int, cooldown: int, unknown_timeout: int) -> set[int]:
    """When one of the subject's times is over."""
    found = episodes(history, hold, cooldown, unknown_timeout)
    rests_until = 0
    if found:
        last = found[-1]
        if last.end is None:
            since = [each for each in history if each.time > last.start]
            unknown = since and isinstance(since[-1], Observation) and since[-1].until is None
            return {_unknown_since(since, "until") + unknown_timeout} if unknown else set()
        rests_until = last.end + cooldown
        history = [each for each in history if each.time > (last.end or 0)]
    onset = _pending(history, hold, rests_until)
    if onset is None:
        return {rests_until}
    last_seen = history[-1]
    unknown = isinstance(last_seen, Observation) and last_seen.condition is None
    return {onset + hold, *([_unknown_since(history, "condition") + hold + 1] if unknown else [])}


def in_progress(history: list[Observation | Break], hold: int, cooldown: int, unknown_timeout: int) -> bool:
    """Whether an episode is open or about to start."""
    found = episodes(history, hold, cooldown, unknown_timeout)
    if not found:
        return bool(history) and _pending(history, hold, 0) is not None
    end = found[-1].end
    if end is None:
        return True
    since = [each for each in history if each.time > end]
    return bool(since) and _pending(since, hold, end + cooldown) is not None


def _onset(history: list[Observation | Break], hold: int, rests_until: int) -> int | None:
    """When the condition began to hold, if it has done so for long enough at the end of the history."""
    last = history[-1]
    if not isinstance(last, Observation) or last.condition is not True:
        return None
    since = _pending(history, hold, rests_until)
    return since if since is not None and last.time - since >= hold else None


def _pending(history: list[Observation | Break], hold: int, rests_until: int) -> int | None:
    """When the condition began to hold, if it does or has been unknown for no longer than `hold`."""
    since: int | None = None
    for index, each in enumerate(history):
        if isinstance(each, Break) or each.condition is False:
            since = None
        elif each.condition is True:
            if since is None and each.time >= rests_until:
                since = each.time
        elif since is not None and each.time - _unknown_since(history[: index + 1], "condition") > hold:
            since = None
    return since


def _unknown_since(history: list[Observation | Break], what: Literal["condition", "until"]) -> int:
    """The first of the ticks at the end of the history at which it was unknown without a break."""
    since = history[-1].time
    for each in reversed(history):
        if isinstance(each, Break) or getattr(each, what) is not None:
            break
        since = each.time
    return since


def _end(history: list[Observation | Break], unknown_timeout: int) -> str | None:
    """Why an episode that started before the history ends with it."""
    last = history[-1]
    if isinstance(last, Break):
        return "ClientLost" if last.lost else None
    if last.in_scope is False:
        return "OutOfScope"
    if last.until is True:
        return "Until"
    if last.until is None and last.time - _unknown_since(history, "until") >= unknown_timeout:
        return "Unknown"
    return None
