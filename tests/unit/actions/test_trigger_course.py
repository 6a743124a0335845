"""The course of a recording elsewhere: confirmed requests are not repeated, others are retried until they are given
up."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from detector.actions.trigger.orders import Order, Progress, Report
from detector.actions.trigger.state_machine import FOREVER, NextRequest, RemoteRecording, Timeouts

RECORDING, DONE = Report(Progress.RECORDING), Report(Progress.DONE, files=("a",))
ENDING, UNKNOWN = Report(Progress.ENDING), Report(Progress.UNKNOWN)


def a_course(
    *, maximum: float = FOREVER, give_up: float = 60, renew: float | None = 10, resumed: bool = False
) -> RemoteRecording:
    return RemoteRecording(Order("x", {}), Timeouts(maximum, give_up, renew), 0, -1, resumed=resumed)


def test_a_recording_is_started_again_stopped_and_awaited() -> None:
    course = a_course()
    assert course.look(0) is NextRequest.START
    course.answered(0, RECORDING)
    assert course.look(9) is None
    assert course.look(10) is NextRequest.HOLD
    course.answered(10, RECORDING)
    course.end(15, 14)
    assert course.look(15) is NextRequest.STOP
    course.answered(15, ENDING)
    assert course.look(15) is None
    assert course.look(16) is NextRequest.AWAIT
    course.answered(16, DONE)
    assert course.finished
    assert course.problem == ""
    assert course.report.files == ("a",)


def test_an_episode_that_is_over_before_the_start_is_confirmed_is_recorded_nevertheless() -> None:
    course = a_course()
    course.failed(0, "silence", silent=True)
    course.end(0.1, 0.1)
    assert course.look(0.2) is None
    assert course.look(0.5) is NextRequest.START
    course.answered(0.5, RECORDING)
    assert course.look(0.5) is NextRequest.STOP


def test_what_is_not_confirmed_is_requested_later_and_later_and_given_up() -> None:
    course = a_course()
    times = []
    for tenth in range(2000):
        step = course.look(tenth / 10)
        if step is NextRequest.START:
            times.append(tenth / 10)
            course.failed(tenth / 10, "silence", silent=True)
        if step is NextRequest.STOP:
            break
    assert times == [0, 0.5, 1.5, 3.5, 7.5, 15.5, 30.5, 45.5, 60.5]
    assert course.problem == "gave up starting the recording: silence"
    assert not course.lost_stop


def test_a_stop_that_is_given_up_is_reported() -> None:
    course = a_course(give_up=5)
    course.answered(0, RECORDING)
    course.end(1, 1)
    for second in range(1, 20):
        if course.look(second) is NextRequest.STOP:
            course.failed(second, "silence", silent=True)
    assert course.finished
    assert course.lost_stop
    assert course.problem == "gave up waiting for the confirmation of the stop: silence"


def test_what_is_refused_is_requested_again_and_then_needs_no_stop() -> None:
    course = a_course(give_up=1)
    for now in (0.0, 0.5, 1.5):
        assert course.look(now) is NextRequest.START
        course.answered(now, Report(Progress.REFUSED, "too many"))
    assert course.finished
    assert course.problem == "gave up starting the recording: too many"


def test_a_system_that_was_restarted_continues_with_the_next_start() -> None:
    course = a_course()
    course.answered(0, RECORDING)
    assert course.confirmed
    for now in (10, 10.5, 11.5, 200):  # it is away for long: as long as the episode lasts, nothing is given up
        assert course.look(now) is NextRequest.HOLD
        course.failed(now, "silence", silent=True)
    assert course.look(300) is NextRequest.HOLD
    course.answered(300, RECORDING)
    course.end(301, 301)
    course.answered(301, UNKNOWN)  # restarted once more, just now
    assert course.finished
    assert "restarted and no longer knows the recording" in course.problem


def test_a_system_that_does_not_count_the_time_is_stopped_after_it() -> None:
    course = a_course(maximum=30, renew=None)
    course.answered(0, RECORDING)
    assert course.next_look() == 30
    assert course.look(29.9) is None
    assert course.look(30) is NextRequest.STOP
    course.answered(30, DONE)
    assert course.note == "the recording reached its maximumDuration before the episode ended"


def test_a_system_that_counts_the_time_itself_reports_it() -> None:
    course = a_course()
    course.answered(0, RECORDING)
    course.answered(10, Report(Progress.DONE, "ended by its maximumDuration"))
    assert course.finished
    assert (course.problem, course.note) == ("", "ended by its maximumDuration")


@given(st.lists(st.tuples(st.sampled_from(["ask", "end"]), st.sampled_from([*Progress, None])), max_size=40))
def test_whatever_is_answered_a_course_comes_to_its_end(happenings: list[tuple[str, Progress | None]]) -> None:
    """And while it is not finished, there is always a time of the next request."""
    course, now = a_course(give_up=20), 0.0

    def turn(progress: Progress | None) -> None:
        nonlocal now
        if course.finished:
            return
        now = max(now, min(course.next_look(), now + 100))
        if course.look(now) is not None:
            if progress is None:
                course.failed(now, "silence", silent=True)
            else:
                course.answered(now, Report(progress))

    for what, progress in happenings:
        if what == "end":
            course.end(now, now)
        turn(progress)
    course.end(now, now)
    for _ in range(100):
        turn(None)
    assert course.finished
