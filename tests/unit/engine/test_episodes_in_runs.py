"""A subject that is brought forward over many ticks at once goes the same way as one that is looked at tick by tick."""

from __future__ import annotations

from itertools import groupby

from hypothesis import given, settings
from hypothesis import strategies as st

from detector.engine.episodes.episodes import (
    FALSE,
    OUTSIDE,
    TRUE,
    UNSURE,
    UNTIL,
    UNTIL_UNSURE,
    Ended,
    Observation,
    Started,
    SubjectState,
    Timing,
    both,
    negation,
)
from wayside.expressions import UNKNOWN

_truths = st.sampled_from([True, True, False, UNKNOWN])
_mostly_false = st.sampled_from([True, False, False, False, UNKNOWN])
_scopes = st.sampled_from([True, True, True, True, False, UNKNOWN])
_observations = st.builds(Observation, _scopes, st.just(True), _truths, _mostly_false)
_runs = st.lists(st.tuples(_observations, st.integers(1, 6)), min_size=1, max_size=12)
_times = st.integers(0, 8)


def code_of(seen: Observation) -> int:
    may = both(seen.in_scope, both(seen.when, negation(seen.until)))
    start = TRUE if may is True else FALSE if may is False else UNSURE
    if seen.in_scope is False:
        return start | OUTSIDE
    return start | (UNTIL if seen.until is True else UNTIL_UNSURE if seen.until is UNKNOWN else 0)


def what_is_left(state: SubjectState) -> tuple[object, ...]:
    """What decides the future."""
    return state.is_open, state.onset, state.rests_until, state.unknown_since if state.is_open or state.onset else None


@settings(max_examples=500)
@given(
    _runs, st.lists(st.integers(1, 3), min_size=1, max_size=80), st.data(), st.builds(Timing, _times, _times, _times)
)
def test_a_run_of_ticks_is_the_same_as_each_tick(
    runs: list[tuple[Observation, int]], between: list[int], data: st.DataObject, timing: Timing
) -> None:
    seen = [observation for observation, count in runs for _ in range(count)]
    ticks = [100]
    for at in range(1, len(seen)):
        ticks.append(ticks[-1] + between[at % len(between)])
    cuts = data.draw(st.sets(st.integers(0, len(seen)), max_size=4))
    stepped, ran = SubjectState(), SubjectState()
    expected: list[tuple[int, Started | Ended]] = []
    for tick, observation in zip(ticks, seen, strict=True):
        if (happened := stepped.step(tick, timing, observation)) is not None:
            expected.append((tick, happened))
    found: list[tuple[int, Started | Ended]] = []
    blocks = groupby(range(len(seen)), key=lambda at: (sum(cut <= at for cut in cuts), code_of(seen[at])))
    for (_, code), block in blocks:
        indices = [*block]
        first, end = indices[0], indices[-1] + 1
        while first < end:
            first, what, _ = ran.run(ticks, first, end, timing, code)
            if what is not None:
                found.append((ticks[first], what))
                first += 1
    assert found == expected
    assert what_is_left(ran) == what_is_left(stepped)


@settings(max_examples=300)
@given(_runs, _observations, st.builds(Timing, _times, _times, _times))
def test_nothing_happens_before_the_wake_of_a_run(
    runs: list[tuple[Observation, int]], last: Observation, timing: Timing
) -> None:
    state, now = SubjectState(), 100
    for observation, count in runs:
        for _ in range(count):
            state.step(now, timing, observation)
            now += 1
    _, what, wake = state.run([now], 0, 1, timing, code_of(last))
    if what is None:
        for tick in range(now + 1, now + 30):
            happened = state.step(tick, timing, last)
            assert happened is None or (wake is not None and tick >= wake)
            if happened is not None:
                break
