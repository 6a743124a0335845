"""Advancing a subject over many ticks at once gives the same states as tick by tick."""

from __future__ import annotations

from itertools import groupby

from hypothesis import given, settings
from hypothesis import strategies as st

from detector.engine.episodes.episodes import (
    Ended,
    EndReason,
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
_observations = st.builds(Observation, _scopes, _scopes, _truths, _mostly_false)
_runs = st.lists(st.tuples(_observations, st.integers(1, 6)), min_size=1, max_size=12)
_times = st.integers(0, 8)


def stepped(state: SubjectState, now: int, timing: Timing, seen: Observation) -> Started | Ended | None:
    """A slow reference of one tick."""
    return open_step(state, now, timing, seen) if state.is_open else idle_step(state, now, timing, seen)


def open_step(state: SubjectState, now: int, timing: Timing, seen: Observation) -> Ended | None:
    reason = None
    if seen.in_scope is False:
        reason = EndReason.OUT_OF_SCOPE
    elif seen.until is True:
        reason = EndReason.UNTIL
    elif seen.until is UNKNOWN:
        if state.unknown_since is None:
            state.unknown_since = now
        if now - state.unknown_since >= timing.unknown_timeout:
            reason = EndReason.UNKNOWN
    else:
        state.unknown_since = None
    if reason is None:
        return None
    state.end(now, timing)
    return Ended(reason)


def idle_step(state: SubjectState, now: int, timing: Timing, seen: Observation) -> Started | None:
    condition = both(both(seen.in_scope, seen.near), both(seen.when, negation(seen.until)))
    if condition is False:
        state.onset = state.unknown_since = None
        return None
    if condition is UNKNOWN:
        if state.onset is not None:
            if state.unknown_since is None:
                state.unknown_since = now
            if now - state.unknown_since > timing.hold:
                state.onset = state.unknown_since = None
        return None
    state.unknown_since = None
    if state.onset is None:
        if now < state.rests_until:
            return None
        state.onset = now
    if now - state.onset < timing.hold:
        return None
    onset, state.onset = state.onset, None
    state.is_open = True
    return Started(onset)


def what_is_left(state: SubjectState) -> tuple[object, ...]:
    """The state that decides later ticks."""
    return state.is_open, state.onset, state.rests_until, state.unknown_since if state.is_open or state.onset else None


@settings(max_examples=500)
@given(
    _runs, st.lists(st.integers(1, 3), min_size=1, max_size=80), st.data(), st.builds(Timing, _times, _times, _times)
)
def test_a_run_of_ticks_equals_single_ticks(
    runs: list[tuple[Observation, int]], between: list[int], data: st.DataObject, timing: Timing
) -> None:
    seen = [observation for observation, count in runs for _ in range(count)]
    ticks = [100]
    for at in range(1, len(seen)):
        ticks.append(ticks[-1] + between[at % len(between)])
    cuts = data.draw(st.sets(st.integers(0, len(seen)), max_size=4))
    slow, ran = SubjectState(), SubjectState()
    expected: list[tuple[int, Started | Ended]] = []
    for tick, observation in zip(ticks, seen, strict=True):
        if (happened := stepped(slow, tick, timing, observation)) is not None:
            expected.append((tick, happened))
    found: list[tuple[int, Started | Ended]] = []
    blocks = groupby(range(len(seen)), key=lambda at: (sum(cut <= at for cut in cuts), seen[at].code))
    for (_, code), block in blocks:
        indices = [*block]
        first, end = indices[0], indices[-1] + 1
        while first < end:
            first, what, _ = ran.run(ticks, first, end, timing, code)
            if what is not None:
                found.append((ticks[first], what))
                first += 1
    assert found == expected
    assert what_is_left(ran) == what_is_left(slow)


@settings(max_examples=300)
@given(_runs, _observations, st.builds(Timing, _times, _times, _times))
def test_nothing_happens_before_the_wake_time_of_a_run(
    runs: list[tuple[Observation, int]], last: Observation, timing: Timing
) -> None:
    state, now = SubjectState(), 100
    for observation, count in runs:
        for _ in range(count):
            stepped(state, now, timing, observation)
            now += 1
    _, what, wake = state.run([now], 0, 1, timing, last.code)
    if what is None:
        for tick in range(now + 1, now + 30):
            happened = stepped(state, tick, timing, last)
            assert happened is None or (wake is not None and tick >= wake)
            if happened is not None:
                break
