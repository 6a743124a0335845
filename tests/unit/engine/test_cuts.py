"""Neither the cut of the input into calls of `Engine.advance` nor evaluation in columns changes a result."""

from __future__ import annotations

import os
from random import Random

from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit.engine.scenes import a_scene, driven


@settings(max_examples=int(os.environ.get("WAYSIDE_EQUIVALENCE", "15")))
@given(st.integers(0, 10**6), st.sampled_from([(10**9,), (10**9,), (1, 3, 40)]))
def test_any_batching_with_or_without_tracing_gives_the_same_events_demands_and_counts(
    seed: int, sizes: tuple[int, ...]
) -> None:
    scene, random = a_scene(seed), Random(seed)
    expected = driven(scene, lambda: 1)
    found = driven(scene, lambda: random.choice(sizes))
    assert found == expected
    by_cel = driven(scene, lambda: 40, one_by_one=True)  # its counts name other reasons, so they differ
    assert (found.events, found.demands) == (by_cel.events, by_cel.demands)
