"""How what comes in is cut into calls of `Engine.advance` changes nothing."""

from __future__ import annotations

import os
from random import Random

from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit.engine.scenes import a_scene, driven


@settings(max_examples=int(os.environ.get("WAYSIDE_EQUIVALENCE", "20")))
@given(st.integers(0, 10**6), st.sampled_from([(10**9,), (10**9,), (1, 3, 40)]))
def test_any_cut_gives_the_same_events_demands_and_counts(seed: int, sizes: tuple[int, ...]) -> None:
    scene, random = a_scene(seed), Random(seed)
    expected = driven(scene, lambda: 1)
    found = driven(scene, lambda: random.choice(sizes))
    assert found.events == expected.events
    assert found.demands == expected.demands
    assert found.counters == expected.counters


@settings(max_examples=int(os.environ.get("WAYSIDE_EQUIVALENCE", "20")))
@given(st.integers(0, 10**6))
def test_rules_in_columns_have_the_events_and_demands_of_rules_evaluated_one_by_one(seed: int) -> None:
    scene = a_scene(seed)
    expected = driven(scene, lambda: 40, one_by_one=True)
    found = driven(scene, lambda: 10**9)
    assert found.events == expected.events
    assert found.demands == expected.demands
