"""How large an instance's merged parameters may be, and who makes them too large. Pure.

Each task is within its own bound, but a Union of many is not. What is too large is not applied: the instance keeps the
values that it has, and every other instance is served.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from application_manager.core.claims.merging import Contribution
from wayside.api import freedata

TOO_LARGE = "ParametersTooLarge"
"""Reason of the condition Applied of an instance whose merged parameters are beyond the bounds."""

MAXIMUM_MERGED_BYTES = 8 * freedata.MAXIMUM_BYTES
"""Bytes of all merged parameters together, as JSON: an object of the API server holds some 1.5 MB in all."""

_SHOWN = 3  # tasks that are named


def too_large(parameters: Mapping[str, Any], contributions: Sequence[Contribution]) -> str:
    """Why the merged parameters are too large, naming the largest contributors; empty where they are not.

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
    return f"{what}, more than the {limit} allowed ({named}{more}): end some of these tasks, or pass references"


def _size(value: Any) -> int:
    return len(json.dumps(value, ensure_ascii=False, separators=(",", ":")).encode())
