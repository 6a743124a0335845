"""A recording elsewhere: confirmed requests are not repeated, others are retried until they are given up."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from detector.actions.trigger.requests import Order, Progress, Report
from detector.actions.trigger.state_machine import FOREVER, NextRequest, RemoteRecording, Timeouts

RECORDING, DONE = Report(Progress.RECORDING), Report(Progress.DONE, files=("a",))
ENDING, UNKNOWN = Report(Progress.ENDING), Report(Progress.UNKNOWN)


def a_recording(
    *, maximum: float = FOREVER, give_up: float = 60, renew: float | None = 10, resumed: bool = False
) -> RemoteRecording:
    return RemoteRecording(Order("x", {}), Timeouts(maximum, give_up, renew), 0, -1, resumed=resumed)


def test_a_recording_is_started_with_retries_stopped_and_awaited() -> None:
    recording = a_recording()
    assert recording.next_request(0) is NextRequest.START
    recording.answered(0, RECORDING)
    assert recording.next_request(9) is None
    assert recording.next_request(10) is NextRequest.HOLD
    recording.answered(10, RECORDING)
    recording.end(15, 14)
    assert recording.next_request(15) is NextRequest.STOP
    recording.answered(15, ENDING)
    assert recording.next_request(15) is None
    assert recording.next_request(16) is NextRequest.AWAIT
    recording.answered(16, DONE)
    assert recording.finished
    assert recording.problem == ""
    assert recording.report.files == ("a",)


def test_an_episode_that_ends_before_its_start_is_confirmed_is_still_recorded() -> None:
    recording = a_recording()
    recording.failed(0, "silence", silent=True)
    recording.end(0.1, 0.1)
    assert recording.next_request(0.2) is None
    assert recording.next_request(0.5) is NextRequest.START
    recording.answered(0.5, RECORDING)
    assert recording.next_request(0.5) is NextRequest.STOP


def test_unconfirmed_requests_are_retried_with_backoff_and_given_up() -> None:
    recording = a_recording()
    times = []
    for tenth in range(2000):
        step = recording.next_request(tenth / 10)
        if step is NextRequest.START:
            times.append(tenth / 10)
            recording.failed(tenth / 10, "silence", silent=True)
        if step is NextRequest.STOP:
            break
    assert times == [0, 0.5, 1.5, 3.5, 7.5, 15.5, 30.5, 45.5, 60.5]
    assert recording.problem == "gave up starting the recording: silence"
    assert not recording.lost_stop


def test_a_stop_that_is_given_up_is_reported() -> None:
    recording = a_recording(give_up=5)
    recording.answered(0, RECORDING)
    recording.end(1, 1)
    for second in range(1, 20):
        if recording.next_request(second) is NextRequest.STOP:
            recording.failed(second, "silence", silent=True)
    assert recording.finished
    assert recording.lost_stop
    assert recording.problem == "gave up waiting for the confirmation of the stop: silence"


def test_a_rejected_start_is_retried_and_needs_no_stop() -> None:
    recording = a_recording(give_up=1)
    for now in (0.0, 0.5, 1.5):
        assert recording.next_request(now) is NextRequest.START
        recording.answered(now, Report(Progress.REFUSED, "too many"))
    assert recording.finished
    assert recording.problem == "gave up starting the recording: too many"


def test_a_system_that_was_restarted_continues_with_the_next_start() -> None:
    recording = a_recording()
    recording.answered(0, RECORDING)
    assert recording.confirmed
    for now in (10, 10.5, 11.5, 200):  # it is away for long: as long as the episode lasts, nothing is given up
        assert recording.next_request(now) is NextRequest.HOLD
        recording.failed(now, "silence", silent=True)
    assert recording.next_request(300) is NextRequest.HOLD
    recording.answered(300, RECORDING)
    recording.end(301, 301)
    recording.answered(301, UNKNOWN)  # restarted once more, just now
    assert recording.finished
    assert "restarted and no longer knows the recording" in recording.problem


def test_a_system_that_does_not_count_the_time_is_stopped_after_it() -> None:
    recording = a_recording(maximum=30, renew=None)
    recording.answered(0, RECORDING)
    assert recording.next_due() == 30
    assert recording.next_request(29.9) is None
    assert recording.next_request(30) is NextRequest.STOP
    recording.answered(30, DONE)
    assert recording.note == "the recording reached its maxDuration before the episode ended"


def test_a_system_that_counts_the_time_itself_reports_it() -> None:
    recording = a_recording()
    recording.answered(0, RECORDING)
    recording.answered(10, Report(Progress.DONE, "ended by its maxDuration"))
    assert recording.finished
    assert (recording.problem, recording.note) == ("", "ended by its maxDuration")


@given(st.lists(st.tuples(st.sampled_from(["ask", "end"]), st.sampled_from([*Progress, None])), max_size=40))
def test_a_recording_always_reaches_a_final_state(happenings: list[tuple[str, Progress | None]]) -> None:
    """And while it is not finished, there is always a time of the next request."""
    recording, now = a_recording(give_up=20), 0.0

    def turn(progress: Progress | None) -> None:
        nonlocal now
        if recording.finished:
            return
        now = max(now, min(recording.next_due(), now + 100))
        if recording.next_request(now) is not None:
            if progress is None:
                recording.failed(now, "silence", silent=True)
            else:
                recording.answered(now, Report(progress))

    for what, progress in happenings:
        if what == "end":
            recording.end(now, now)
        turn(progress)
    recording.end(now, now)
    for _ in range(100):
        turn(None)
    assert recording.finished
