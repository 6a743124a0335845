"""Starts and ends of episodes, compared with a definition over the whole history."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from detector.engine.episodes.episodes import (
    Ended,
    EndReason,
    Observation,
    Started,
    SubjectState,
    Timing,
    Truth,
    both,
    negation,
)
from wayside.expressions import UNKNOWN

TRUTHS: tuple[Truth, ...] = (True, False, UNKNOWN)

Happening = tuple[int, str]
"""When, and `started <onset>` or the reason of the end."""


@dataclass(frozen=True)
class Moment:
    """The observation at a tick."""

    time: int
    seen: Observation

    @property
    def condition(self) -> float:
        """Whether an episode may be on its way: 1 yes, 0 no, a half unknown; the least of all required conditions."""
        seen = self.seen
        return min(worth(seen.in_scope), worth(seen.near), worth(seen.when), 1 - worth(seen.until))


def worth(truth: Truth) -> float:
    return float(truth) if isinstance(truth, bool) else 0.5


def run(history: list[Moment], timing: Timing) -> list[Happening]:
    """The results of the state machine."""
    state = SubjectState()
    happenings = []
    for moment in history:
        match state.step(moment.time, timing, moment.seen):
            case Started(onset):
                happenings.append((moment.time, f"started {onset}"))
            case Ended(reason):
                happenings.append((moment.time, reason.value))
            case None:
                pass
    return happenings


def read(history: list[Moment], timing: Timing) -> list[Happening]:
    """The definition, by looking back from every moment."""
    happenings: list[Happening] = []
    begin, rests_until = 0, 0
    while (found := first_start(history, begin, rests_until, timing)) is not None:
        start, onset = found
        happenings.append((history[start].time, f"started {onset}"))
        ended = first_end(history, start, timing)
        if ended is None:
            break
        end, reason = ended
        happenings.append((history[end].time, reason))
        begin, rests_until = end + 1, history[end].time + timing.cooldown
    return happenings


def first_start(history: list[Moment], begin: int, rests_until: int, timing: Timing) -> tuple[int, int] | None:
    for now in range(begin, len(history)):
        if history[now].condition == 1:
            onset = onset_of(history, begin, now, rests_until, timing)
            if onset is not None and history[now].time - onset >= timing.hold:
                return now, onset
    return None


def onset_of(history: list[Moment], begin: int, now: int, rests_until: int, timing: Timing) -> int | None:
    """The first moment after the last break at which the condition held and the subject did not rest."""
    breaks = [at for at in range(begin, now) if is_break(history, begin, at, timing)]
    after = breaks[-1] + 1 if breaks else begin
    held = [m.time for m in history[after : now + 1] if m.condition == 1 and m.time >= rests_until]
    return held[0] if held else None


def is_break(history: list[Moment], begin: int, at: int, timing: Timing) -> bool:
    if history[at].condition == 0:
        return True
    since = at
    while since > begin and history[since - 1].condition == 0.5:
        since -= 1
    return history[at].condition == 0.5 and history[at].time - history[since].time > timing.hold


def first_end(history: list[Moment], start: int, timing: Timing) -> tuple[int, str] | None:
    for now in range(start + 1, len(history)):
        seen = history[now].seen
        if seen.in_scope is False:
            return now, "OutOfScope"
        if seen.until is True:
            return now, "Until"
        since = now
        while since > start + 1 and history[since - 1].seen.until is UNKNOWN:
            since -= 1
        if seen.until is UNKNOWN and history[now].time - history[since].time >= timing.unknown_timeout:
            return now, "Unknown"
    return None


truths = st.sampled_from(TRUTHS)
often_true = st.sampled_from((True, True, True, UNKNOWN, False))
seldom_true = st.sampled_from((False, False, False, UNKNOWN, True))
observations = st.builds(Observation, often_true, often_true, often_true, seldom_true) | st.builds(
    Observation, truths, truths, truths, truths
)
timings = st.builds(Timing, st.integers(0, 6), st.integers(0, 8), st.integers(0, 8))


@st.composite
def histories(draw: st.DrawFn) -> list[Moment]:
    steps = draw(st.lists(st.tuples(st.integers(1, 3), observations), max_size=40))
    time, history = 0, []
    for pause, seen in steps:
        time += pause
        history.append(Moment(time, seen))
    return history


SEEN = Observation(in_scope=True, near=True, when=True, until=False)
"""An episode may start and continue."""


def seen(**fields: Truth) -> Observation:
    return replace(SEEN, **fields)


def second_by_second(*observations: Observation) -> list[Moment]:
    return [Moment(time, each) for time, each in enumerate(observations)]


UNDECIDED, LASTS = seen(when=UNKNOWN), seen(until=UNKNOWN)
ENDS = seen(until=True)


@given(histories(), timings)
@example(second_by_second(seen(when=False), SEEN, SEEN, SEEN), Timing(2, 0, 9))
@example(second_by_second(SEEN, *[UNDECIDED] * 3, SEEN), Timing(2, 0, 9))
@example(second_by_second(SEEN, *[UNDECIDED] * 4, SEEN, SEEN, SEEN), Timing(2, 0, 9))
@example(second_by_second(SEEN, seen(near=UNKNOWN), SEEN), Timing(2, 0, 9))
@example(second_by_second(SEEN, seen(near=False), SEEN), Timing(2, 0, 9))
@example(second_by_second(SEEN, seen(near=False), ENDS), Timing(0, 0, 9))
@example(second_by_second(SEEN, seen(in_scope=False, until=True)), Timing(0, 0, 9))
@example(second_by_second(SEEN, seen(in_scope=UNKNOWN, until=True)), Timing(0, 0, 9))
@example(second_by_second(SEEN, seen(in_scope=UNKNOWN), SEEN), Timing(0, 0, 9))
@example(second_by_second(SEEN, LASTS, LASTS, SEEN, LASTS, LASTS, LASTS), Timing(0, 0, 2))
@example(second_by_second(SEEN, SEEN, ENDS, *[SEEN] * 5), Timing(1, 3, 9))
@example(second_by_second(*[ENDS] * 3), Timing(0, 0, 9))
def test_episodes_match_the_definition_over_the_whole_history(history: list[Moment], timing: Timing) -> None:
    assert run(history, timing) == read(history, timing)


def test_an_episode_from_its_onset_to_the_end_of_its_cooldown() -> None:
    history = second_by_second(SEEN, SEEN, ENDS, *[SEEN] * 5)
    assert run(history, Timing(1, 3, 9)) == [(1, "started 0"), (2, "Until"), (6, "started 5")]


def test_after_a_gap_pending_onsets_restart_and_open_episodes_stay_open() -> None:
    timing = Timing(2, 0, 2)
    state = SubjectState()
    state.step(0, timing, SEEN)
    state.gap()
    assert state.step(100, timing, SEEN) is None
    assert state.step(102, timing, SEEN) == Started(100)
    state.step(103, timing, seen(until=UNKNOWN))
    state.gap()
    assert state.step(200, timing, seen(until=UNKNOWN)) is None
    assert state.step(202, timing, seen(until=UNKNOWN)) == Ended(EndReason.UNKNOWN)


@pytest.mark.parametrize("first", TRUTHS)
@pytest.mark.parametrize("second", TRUTHS)
def test_and_and_not_follow_kleene(first: Truth, second: Truth) -> None:
    assert worth(both(first, second)) == min(worth(first), worth(second))
    assert worth(negation(first)) == 1 - worth(first)
