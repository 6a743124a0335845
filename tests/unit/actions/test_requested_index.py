"""The index of requested recordings: requests are idempotent and bounded."""

from __future__ import annotations

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from detector.actions.episode import Outcome, OutcomeState
from detector.actions.trigger.requests import (
    MAXIMUM_BYTES,
    Progress,
    RecordingRequest,
    read_request,
    short,
    write_request,
)
from detector.live.requested import REQUESTED, RecordingIndex, with_requested
from wayside.api import Detector
from wayside.api.base import Duration, PositiveDuration
from wayside.api.recordings import OnRequest

STREAMS = ["camera", "points"]
SECOND = 10**9
NOW = 1_700_000_000 * SECOND


def start(identity: str, **fields: object) -> RecordingRequest:
    return RecordingRequest.model_validate({"do": "start", "id": identity, **fields})


def stop(identity: str, **fields: object) -> RecordingRequest:
    return RecordingRequest.model_validate({"do": "stop", "id": identity, **fields})


def test_times_are_relative_to_the_own_clock() -> None:
    _, entry = RecordingIndex().start(start("x", before="5s", ago="2s", maxDuration="1m"), OnRequest(), STREAMS, NOW)
    assert entry is not None
    assert (entry.since, entry.until) == (NOW - 7 * SECOND, NOW + 60 * SECOND)


def test_the_duration_of_a_request_is_limited() -> None:
    allowed = OnRequest(max_duration=PositiveDuration("10s"))
    _, entry = RecordingIndex().start(start("x", maxDuration="1h"), allowed, STREAMS, NOW)
    assert entry is not None
    assert entry.until == NOW + 10 * SECOND


def test_a_stop_counts_from_the_end_of_its_cause_and_never_extends_the_recording() -> None:
    for fields, until in (
        ({"ago": "1s", "after": "3s"}, 2),
        ({"ago": "9s"}, -9),
        ({"after": "1h"}, 60),
        ({"ago": "1h"}, -10),
    ):
        index = RecordingIndex()
        index.start(start("x", before="10s", maxDuration="1m"), OnRequest(), STREAMS, NOW)
        report, entry = index.stop(stop("x", **fields), NOW)
        assert entry is not None
        assert entry.until == NOW + until * SECOND
        assert report.state is Progress.ENDING
        assert index.stop(stop("x"), NOW) == (report, None)


@given(st.lists(st.tuples(st.sampled_from(["start", "stop", "done", "failed", "running"]), st.integers(0, 4))))
def test_an_id_starts_one_recording_and_concurrent_recordings_are_limited(happenings: list[tuple[str, int]]) -> None:
    index, allowed, open_ones, begun = RecordingIndex(), OnRequest(max_recordings=2), set[str](), set[str]()
    for what, number in happenings:
        identity = f"x{number}"
        if what == "start":
            report, entry = index.start(start(identity), allowed, STREAMS, NOW)
            if entry is not None:
                assert identity not in begun
                open_ones.add(identity)
                begun.add(identity)
            if identity in open_ones:
                assert report.state in (Progress.RECORDING, Progress.ENDING)
        elif what == "stop":
            report, _ = index.stop(stop(identity), NOW)
            begun.add(identity)  # it can no longer be
            assert report.state is not Progress.RECORDING
        else:
            index.update(identity, Outcome(OutcomeState(what.capitalize())))
            if what != "running":
                open_ones.discard(identity)
        assert len(open_ones) <= 2
        states = {report.id: report.state for report in msgspec.convert(index.status(None), list)}
        assert all(states[each] in (Progress.RECORDING, Progress.ENDING) for each in open_ones)


def test_finished_recordings_are_eventually_forgotten() -> None:
    index = RecordingIndex()
    for number in range(600):
        index.start(start(f"x{number}"), OnRequest(), STREAMS, NOW)
        index.update(f"x{number}", Outcome(OutcomeState.DONE))
        index.stop(stop(f"y{number}"), NOW)
    known = index.status(None)
    assert isinstance(known, list)
    assert len(known) <= 1000
    assert index.status("x0") == msgspec.structs.replace(index.status("x1"), id="x0")  # type: ignore[arg-type]


def test_the_event_of_a_large_fleet_fits_into_a_request() -> None:
    event = {"id": "e", "data": {"rule": "r", "values": {"members": [{"client": f"car{n}"} for n in range(10_000)]}}}
    request = RecordingRequest(do="start", id="x", event=short(event), before=Duration("1s"))
    payload = write_request(request)
    assert len(payload) < MAXIMUM_BYTES
    assert read_request(payload).event == {"id": "e", "data": {"rule": "r"}}
    assert short({"id": "e", "data": {"values": {"v": 1}}}) == {"id": "e", "data": {"values": {"v": 1}}}


def test_recordings_on_request_run_under_a_rule_with_a_reserved_name() -> None:
    detector = Detector.model_validate(
        {
            "apiVersion": "wayside.dev/v1alpha1",
            "kind": "Detector",
            "metadata": {"name": "town"},
            "spec": {
                "streams": [{"name": "pose", "key": "${client:*}/pose", "encoding": "json"}],
                "recordings": {"path": "/recordings", "onRequest": {}},
            },
        }
    )
    (rule,) = with_requested([], detector)
    assert (rule.name, [action.name for action in rule.spec.actions]) == (REQUESTED.rule, [REQUESTED.action])
