"""Merged parameters are bounded, and the largest contributors are named."""

from __future__ import annotations

from application_manager.core.claims.merging import MAXIMUM_MERGED_BYTES, Contribution, too_large
from wayside.api import freedata


def text(size: int) -> str:
    return "x" * (size - 2)  # with its quotes


def test_a_parameter_may_be_at_most_as_large_as_a_task() -> None:
    assert too_large({}, []) == ""
    assert too_large({"a": text(freedata.MAXIMUM_BYTES)}, []) == ""
    assert too_large({"a": text(freedata.MAXIMUM_BYTES + 1)}, []).startswith(
        "spec.parameters.a: the merged value takes 65537 bytes as JSON, more than the 65536 allowed"
    )


def test_all_parameters_together_have_a_bound_too() -> None:
    whole = {str(each): text(freedata.MAXIMUM_BYTES) for each in range(8)}
    assert too_large(whole, []) == ""
    assert f"more than the {MAXIMUM_MERGED_BYTES} allowed" in too_large(whole | {"one": 1}, [])


def test_the_largest_contributors_come_first_and_the_others_are_counted() -> None:
    given = [Contribution(f"t{size}", {"a": text(size)}) for size in (10, 40, 30, 20, 50)]
    logged = too_large({"a": text(70_000)}, [*given, Contribution("other", {"b": text(90_000)})])
    assert (
        "(task t50 gives 50 bytes, task t40 gives 40 bytes, task t30 gives 30 bytes and 2 more tasks with smaller"
        in logged
    )
