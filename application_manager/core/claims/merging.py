"""Merges the values of several tasks, parameter by parameter, by the template's strategies. Pure.

Only the order of precedence matters: the order of arrival, and duplicates, have no influence. A default counts only if
no task gives the parameter, so defaults are not added here.

The size of each task is limited, but the size of a Union of many tasks is not. A result that is too large is not
applied: the instance keeps its values, and other instances are not affected.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from application_manager.core.claims import values
from wayside.api import freedata
from wayside.api.parameter import Merge, Parameter

BASELINE = "the template's baseline"


@dataclass(frozen=True, slots=True)
class Contribution:
    """The values of one task."""

    task: str
    parameters: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Conflict:
    """A task that differs from an earlier one, or from the baseline, in a parameter with strategy Same."""

    parameter: str
    value: Any
    other: Any
    other_task: str | None

    def message(self) -> str:
        """The refusal, with field, value and remedy."""
        whose, until = (f"task {self.other_task}", "wait until that task ends, ") if self.other_task else (BASELINE, "")
        return (
            f"spec.parameters.{self.parameter}: {values.shown(self.value)} differs from {values.shown(self.other)} of "
            f"{whose}, but the parameter has merge strategy Same: give the same value, {until}"
            "or let the template's key distinguish the two"
        )


@dataclass(frozen=True, slots=True)
class Merged:
    """One value for each parameter that a task or the baseline gives, without defaults.

    `conflicts`: the tasks that could not take part, by name; `capped`: a message about each sum that went beyond its
    parameter's bounds.
    """

    parameters: dict[str, Any]
    conflicts: dict[str, Conflict]
    capped: tuple[str, ...] = ()


def merge(
    declared: Mapping[str, Parameter],
    contributions: Sequence[Contribution],
    baseline: Mapping[str, Any] | None = None,
) -> Merged:
    """Merge the tasks' values, which are valid for the template, in the given order: the first has precedence.

    With strategy Same, all must agree with the baseline; with others, it has the lowest priority.
    """
    agreeing, conflicts = _agreeing(declared, contributions, baseline or {})
    values_of = [each.parameters for each in agreeing] + ([baseline] if baseline is not None else [])
    result: dict[str, Any] = {}
    capped: list[str] = []
    for name, parameter in declared.items():
        given = [each[name] for each in values_of if name in each]
        if not given:
            continue
        value = _merged(parameter.merge, given)
        if parameter.merge is Merge.SUM:
            total, value = value, _within(parameter, value)
            if total != value:
                limit = "maximum" if total > value else "minimum"
                capped.append(
                    f"{name}: the sum of {len(given)} values, {_shown(total)}, is capped at the {limit} of {value:g}"
                )
        result[name] = values.normal(value)
    return Merged(result, conflicts, tuple(capped))


def _agreeing(
    declared: Mapping[str, Parameter], contributions: Sequence[Contribution], baseline: Mapping[str, Any]
) -> tuple[list[Contribution], dict[str, Conflict]]:
    """The tasks that take part: in their order, each that agrees with all earlier ones in the parameters with Same."""
    same = {name for name, each in declared.items() if each.merge is Merge.SAME}
    agreed: dict[str, tuple[Any, str | None]] = {name: (baseline[name], None) for name in same & baseline.keys()}
    agreeing: list[Contribution] = []
    conflicts: dict[str, Conflict] = {}
    for each in contributions:
        for name in sorted(same & each.parameters.keys() & agreed.keys()):
            other, task = agreed[name]
            if values.canonical(each.parameters[name]) != values.canonical(other):
                conflicts[each.task] = Conflict(name, each.parameters[name], other, task)
                break
        else:
            agreeing.append(each)
            for name in same & each.parameters.keys() - agreed.keys():
                agreed[name] = (each.parameters[name], each.task)
    return agreeing, conflicts


def _merged(strategy: Merge, given: Sequence[Any]) -> Any:
    match strategy:
        case Merge.SAME | Merge.HIGHEST_PRIORITY:
            return given[0]
        case Merge.MAX:
            return max(given)
        case Merge.MIN:
            return min(given)
        case Merge.SUM:
            return sum(map(Fraction, given))  # exact, so that the order of the tasks does not show in the last digit
        case Merge.ALL:
            return all(given)
        case Merge.ANY:
            return any(given)
        case Merge.UNION | Merge.INTERSECTION:
            return _items(strategy, given)


def _items(strategy: Merge, given: Sequence[Sequence[Any]]) -> list[Any]:
    lists = [{values.canonical(item): item for item in each} for each in given]
    items = {text: item for each in lists for text, item in each.items()}
    kept = items if strategy is Merge.UNION else {t: i for t, i in items.items() if all(t in each for each in lists)}
    return sorted(kept.values(), key=values.sort_key)


def _shown(total: Fraction) -> str:
    try:
        return f"{float(total):g}"
    except OverflowError:
        return "more than a number can represent"


def _within(parameter: Parameter, total: Fraction) -> int | float:
    """The sum as a number within the parameter's bounds."""
    largest = sys.float_info.max
    low = -largest if parameter.minimum is None else parameter.minimum
    high = largest if parameter.maximum is None else parameter.maximum
    if total > high:
        return high
    if total < low:
        return low
    return int(total) if total.denominator == 1 else float(total)


TOO_LARGE = "ParametersTooLarge"
"""Reason of the condition Applied of an instance whose merged parameters are too large."""

MAXIMUM_MERGED_BYTES = 8 * freedata.MAXIMUM_BYTES
"""Bytes of all merged parameters together, as JSON: an object of the API server has at most about 1.5 MB."""

_SHOWN = 3  # tasks to name


def too_large(parameters: Mapping[str, Any], contributions: Sequence[Contribution]) -> str:
    """Why the merged parameters are too large, with the largest contributors; empty if they are not.

    One parameter may take `freedata.MAXIMUM_BYTES`, all of them `MAXIMUM_MERGED_BYTES`.
    """
    sizes = {name: _size(value) for name, value in parameters.items()}
    if not sizes:
        return ""
    name, largest = max(sizes.items(), key=lambda each: each[1])
    total = sum(sizes.values())
    if largest > freedata.MAXIMUM_BYTES:
        what = f"spec.parameters.{name}: the merged value takes {largest} bytes as JSON"
        limit = freedata.MAXIMUM_BYTES
    elif total > MAXIMUM_MERGED_BYTES:
        what = f"spec.parameters: the merged values take {total} bytes as JSON, {largest} of them {name}"
        limit = MAXIMUM_MERGED_BYTES
    else:
        return ""
    given = {each.task: _size(each.parameters[name]) for each in contributions if name in each.parameters}
    first = sorted(given.items(), key=lambda each: (-each[1], each[0]))
    named = ", ".join(f"task {task} gives {size} bytes" for task, size in first[:_SHOWN])
    more = f" and {len(first) - _SHOWN} more tasks with smaller values" if len(first) > _SHOWN else ""
    remedy = "end some of these tasks, or pass references to the data"
    return f"{what}, more than the {limit} allowed ({named}{more}): {remedy}"


def _size(value: Any) -> int:
    return len(json.dumps(value, ensure_ascii=False, separators=(",", ":")).encode())
