"""The time span of the data that a rule needs to detect its event, as far as the rule defines it.

A rule that uses only the newest samples needs none. Windows need their length, and `for` is added. A plugin, the age of
a sample and the like may look back any time; the known time is then a minimum.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from wayside.api import EventRule
from wayside.api.eventrule import Aggregate, Signal
from wayside.rules.contradictions.case import conditions, detecting, span

_OF_ANY_TIME = frozenset({Aggregate.FIRST, Aggregate.PREVIOUS, Aggregate.AGE, Aggregate.ACTIVE})
"""Without a window, these aggregates may look back any time."""

_CLOSING_SPEED_NS = 10**9
"""The closing speed is the change of the distance over the last second."""


@dataclass(frozen=True)
class LookBackTime:
    """The time that a rule looks back."""

    ns: int
    """The minimum time, in nanoseconds."""
    why: str
    """The fields that determine it, or an explanation if there are none."""
    any_time: bool
    """Whether it may look back farther, by an unknown time."""


class _Reach(NamedTuple):
    ns: int
    why: str
    any_time: bool = False


def observation(rule: EventRule, others: Mapping[str, EventRule]) -> LookBackTime:
    """The time that the rule looks back, including the rules that it names."""
    return _observation(rule, others, frozenset())


def _observation(rule: EventRule, others: Mapping[str, EventRule], above: frozenset[str]) -> LookBackTime:
    reaches = list(_reaches(rule, others, above | {rule.name}))
    longest = max(reaches, key=lambda reach: reach.ns, default=_Reach(0, ""))
    why = [longest.why] if longest.ns else []
    if rule.spec.for_.ns:
        why.append(f"spec.for: {rule.spec.for_}")
    return LookBackTime(
        longest.ns + rule.spec.for_.ns,
        " and ".join(why) or "it uses only the newest samples",
        any(reach.any_time for reach in reaches),
    )


def _reaches(rule: EventRule, others: Mapping[str, EventRule], above: frozenset[str]) -> Iterator[_Reach]:
    of = [signal.of for _, signal in detecting(rule) if signal.of is not None]
    if any("closingSpeed" in condition for condition in (*conditions(rule), *of)):
        yield _Reach(_CLOSING_SPEED_NS, "closingSpeed")
    for index, signal in detecting(rule):
        own = _reach(f"spec.signals[{index}]", signal)
        if signal.rule_name is None or signal.rule_name in above:
            yield own
        elif signal.rule_name not in others:
            yield own._replace(any_time=True)
        else:
            other = _observation(others[signal.rule_name], others, above)
            why = f"{other.why} of the rule {signal.rule_name}" if other.ns else ""
            yield _Reach(
                own.ns + other.ns,
                " and ".join(each for each in (own.why, why) if each),
                own.any_time or other.any_time,
            )


def _reach(at: str, signal: Signal) -> _Reach:
    if signal.plugin is not None:
        return _Reach(0, "", any_time=True)
    if signal.model is not None:
        windows = [each.window for each in signal.model.inputs if each.window is not None]
        longest = max((window.over for window in windows if window.over is not None), key=lambda o: o.ns, default=None)
        # The time of a number of samples is unknown.
        any_time = any(window.over is None for window in windows)
        return _Reach(0, "", any_time) if longest is None else _Reach(longest.ns, f"{at}.model: {longest}", any_time)
    if signal.lag is not None:
        over = 0 if signal.over is None else signal.over.ns
        return _Reach(signal.lag.ns + over, f"{at}.lag: {signal.lag}" + (f" and over: {signal.over}" if over else ""))
    if signal.aggregate is Aggregate.LAST and signal.rule_name is None:
        return _Reach(0, "")  # `over` limits its age; one sample is enough
    if signal.over is not None:
        return _Reach(signal.over.ns, f"{at}.over: {signal.over}")
    return _Reach(0, "", any_time=signal.aggregate in _OF_ANY_TIME or signal.rule_name is not None)


def looks_back(observed: LookBackTime) -> str:
    """The text of an observation, for a warning."""
    if not observed.ns:
        return observed.why
    return f"it looks back {span(observed.ns)} ({observed.why})"
