"""Notifications over HTTP and Zenoh: delivery, retries, and dead letters."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import zenoh
from cloudevents.core.bindings.http import HTTPMessage, from_http_event
from msgspec.structs import replace

from detector.actions import Completion, OutcomeState
from detector.actions.notify import outbox
from tests.http_servers import (
    Behaviour,
    Endpoint,
    Received,
    answers,
    first_then,
    hangs,
    nobody,
)
from tests.networks import session
from tests.notifying import a_harness, an_episode
from tests.patience import PATIENCE

LOST = "events not delivered to any target"


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Retries after hundredths of a second."""
    monkeypatch.setattr(outbox, "FIRST", 0.02)
    monkeypatch.setattr(outbox, "LONGEST", 0.1)


def http(there: Endpoint | str, timeout: str = "30s", **fields: Any) -> dict[str, Any]:
    url = there if isinstance(there, str) else there.url
    return {"url": f"{url}/hook", "timeout": timeout, **fields}


def events(requests: list[Received]) -> list[dict[str, Any]]:
    return [json.loads(request.body) for request in requests]


def ids(requests: list[Received]) -> list[str]:
    return [event["id"] for event in events(requests)]


def letters(state: Path) -> list[dict[str, Any]]:
    (file,) = (state / "notify").glob("*.dead.jsonl")
    return [json.loads(line) for line in file.read_text().splitlines()]


@pytest.mark.parametrize("mode", ["Structured", "Binary"])
def test_the_cloudevents_sdk_reads_what_arrives(there: Endpoint, mode: str) -> None:
    texts = {"title": "car1 brakes", "text": "at 12.5 m/s", "labels": {"severity": "warning", "speed": 12.0}}
    harness = a_harness({"http": http(there, mode=mode)})
    harness.run(an_episode(client="Käfer 1%", rendered=texts))
    start, end = there.received(2)
    for request, what in ((start, "started"), (end, "ended")):
        event = from_http_event(HTTPMessage(request.headers, request.body))
        assert event.get_id() == f"e1.{what}"
        assert event.get_type() == f"dev.wayside.event.{what}"
        assert event.get_source() == "/detectors/h"
        assert event.get_subject() == "Käfer 1%"
        data = event.get_data()
        assert isinstance(data, dict)
        assert data["values"] == {"speed": 12.5}
        assert data["notification"] == {**texts, "labels": {"severity": "warning", "speed": "12"}}
    assert (start.method, start.path) == ("POST", "/hook")
    done = harness.outcome("e1")
    assert done.details == {"messages": 2, "attempts": 2}
    assert done.bytes > 0
    harness.end()


@pytest.mark.parametrize(("wanted", "reported"), [(["Started"], ["e1.started"]), (["Ended"], ["e1.ended"])])
def test_only_the_wanted_events_are_reported(there: Endpoint, wanted: list[str], reported: list[str]) -> None:
    harness = a_harness({"http": http(there), "events": wanted})
    harness.run(an_episode())
    harness.outcome("e1")
    assert ids(there.requests) == reported
    harness.end()


@pytest.mark.parametrize("fault", [answers(500, b"out of memory"), hangs()], ids=["500", "hangs"])
def test_failed_notifications_are_retried_until_delivered(there: Endpoint, fault: Behaviour) -> None:
    there.behaviour = fault
    harness = a_harness({"http": http(there, "200ms"), "events": ["Started"]})
    harness.run(an_episode())
    there.received(2)
    running = harness.outcome("e1", OutcomeState.RUNNING)
    assert running.message.startswith("not delivered yet: ")
    there.behaviour = answers(204)
    assert harness.outcome("e1").details["attempts"] >= 3
    assert set(ids(there.requests)) == {"e1.started"}
    assert not harness.lost
    harness.end()


def test_a_rejected_notification_becomes_a_dead_letter_at_once(there: Endpoint, tmp_path: Path) -> None:
    there.behaviour = answers(400, b"no such field: x")
    harness = a_harness({"http": http(there), "text": "${a}"}, state=tmp_path)
    harness.run(an_episode(rendered={"text": "car1 brakes"}))
    failed = harness.outcome("e1", OutcomeState.FAILED)
    assert failed.message.startswith("not delivered: answered 400: no such field: x")
    assert failed.missing == 2
    assert harness.lost[LOST] == 2
    assert len(there.requests) == 2
    first, second = letters(tmp_path)
    assert (first["event"]["id"], second["event"]["id"]) == ("e1.started", "e1.ended")
    assert first["texts"] == {"text": "car1 brakes"}
    assert (first["rule"], first["action"], first["attempts"]) == ("braking", "notify", 1)
    harness.end()


def test_notifications_not_delivered_in_time_are_given_up(tmp_path: Path) -> None:
    with nobody() as gone:
        harness = a_harness({"http": http(gone), "giveUpAfter": "100ms", "events": ["Ended"]}, state=tmp_path)
        harness.run(an_episode())
        failed = harness.outcome("e1", OutcomeState.FAILED)
        assert "attempts, http://localhost" in failed.message
        assert "/hook" not in failed.message
        assert [letter["event"]["id"] for letter in letters(tmp_path)] == ["e1.ended"]
        harness.end()


def test_a_message_the_endpoint_cannot_process_delays_no_other_episode(there: Endpoint) -> None:
    def poisoned(here: Endpoint, connection: Any, request: Received) -> None:
        answers(500 if b'"e1.' in request.body else 200)(here, connection, request)

    there.behaviour = poisoned
    harness = a_harness({"http": http(there)})
    harness.run(an_episode("e1"), an_episode("e2"))
    harness.outcome("e2")
    assert "e1.ended" not in ids(there.requests), "the end is not sent before the start"
    harness.end()


def test_the_end_is_reported_after_the_start(there: Endpoint) -> None:
    there.behaviour = answers(500)
    harness = a_harness({"http": http(there)})
    harness.run(an_episode())
    there.received(3)
    there.behaviour = answers(200)
    harness.outcome("e1")
    reported = ids(there.requests)
    assert reported[-1] == "e1.ended"
    assert set(reported[:-1]) == {"e1.started"}
    harness.end()


def test_retry_after_of_an_endpoint_is_honoured(there: Endpoint, monkeypatch: pytest.MonkeyPatch) -> None:
    there.behaviour = first_then(answers(429, Retry_After="1"), answers(200))
    harness = a_harness({"http": http(there), "events": ["Started"]})
    harness.run(an_episode("e1"), an_episode("e2"))
    harness.outcome("e1")
    assert there.requests[1].at - there.requests[0].at > 0.9
    harness.outcome("e2")
    assert len(there.requests) == 3
    harness.end()


def test_the_publisher_does_not_wait_for_an_endpoint_that_hangs(there: Endpoint) -> None:
    there.behaviour = hangs()
    harness = a_harness({"http": http(there, f"{PATIENCE:g}s"), "waiting": 3, "events": ["Started"]})
    harness.run(an_episode("e0"))
    there.received(1)
    begun = time.monotonic()
    harness.run(*(an_episode(f"e{number}") for number in range(1, 200)))
    assert time.monotonic() - begun < PATIENCE / 2
    assert harness.lost[LOST] == 197  # three wait, one of them being sent
    assert "the queue is full" in harness.outcome("e199", OutcomeState.FAILED).message
    begun = time.monotonic()
    harness.end()
    assert time.monotonic() - begun < PATIENCE / 2, "the end does not wait for the endpoint either"


def test_notifications_of_a_hundred_vehicles_are_grouped_into_one_message(there: Endpoint) -> None:
    harness = a_harness(
        {
            "http": http(there),
            "events": ["Started"],
            "text": "${client} stands",
            "labels": {"road": "${road}"},
            "grouping": {"wait": "3s", "by": ["road"], "maxEvents": 3},
        }
    )
    for number in range(100):
        harness.run(an_episode(f"e{number}", f"car{number}", {"text": f"car{number} stands", "labels": {"road": "A1"}}))
    harness.run(an_episode("other", "bus", {"text": "bus stands", "labels": {"road": "B7"}}))
    first, second = events(there.received(2))
    assert first["type"] == "dev.wayside.event.group"
    assert first["data"]["count"] == first["data"]["started"] == 100
    assert [event["subject"] for event in first["data"]["events"]] == ["car0", "car1", "car2"]
    assert first["data"]["omitted"] == 97
    assert first["data"]["notification"] == {"text": "car0 stands (and 99 more)", "labels": {"road": "A1"}}
    assert (second["data"]["count"], second["data"]["notification"]["text"]) == (1, "bus stands")
    for number in range(100):
        harness.outcome(f"e{number}")
    assert len(there.requests) == 2
    harness.end()


def test_the_message_rate_is_limited(there: Endpoint) -> None:
    harness = a_harness({"http": http(there), "events": ["Started"], "rate": {"messages": 3, "per": "1h"}})
    harness.run(*(an_episode(f"e{number}") for number in range(10)))
    there.received(3)
    harness.outcome("e2")
    harness.end()  # also then
    assert len(there.requests) == 3
    assert harness.lost[LOST] == 7


def test_at_shutdown_queued_messages_are_tried_once_more(there: Endpoint, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outbox, "FIRST", 60.0)
    monkeypatch.setattr(outbox, "LONGEST", 60.0)
    there.behaviour = answers(500)
    harness = a_harness({"http": http(there), "events": ["Started"]})
    harness.run(an_episode("e1"), an_episode("e2"))
    harness.outcome("e2", OutcomeState.RUNNING)
    there.behaviour = answers(200)
    harness.end()
    harness.outcome("e1")
    harness.outcome("e2")
    assert not harness.lost
    assert len(there.requests) == 4


def test_at_shutdown_a_group_is_sent_without_waiting(there: Endpoint) -> None:
    harness = a_harness({"http": http(there), "grouping": {"wait": "1h"}})
    harness.run(an_episode("e1"), an_episode("e2"))
    harness.end()
    assert [event["data"]["count"] for event in events(there.requests)] == [4]


def test_at_shutdown_undelivered_messages_without_a_journal_become_dead_letters() -> None:
    with nobody() as gone:
        harness = a_harness({"http": http(gone), "events": ["Started"]})
        harness.run(an_episode("e1"), an_episode("e2"))
        harness.end()
    assert harness.lost[LOST] == 2
    assert "before the event was delivered" in harness.outcome("e1", OutcomeState.FAILED).message


def test_journalled_messages_undelivered_at_shutdown_are_delivered_after_a_restart(
    there: Endpoint, tmp_path: Path
) -> None:
    there.behaviour = answers(503)
    notify = {"http": http(there), "text": "x"}
    first = a_harness(notify, state=tmp_path)
    first.run(an_episode("e1", rendered={"text": "car1 brakes"}))
    there.received(1)
    first.end()
    assert not first.lost
    assert "after its next start" in first.outcomes[-1][1].message
    there.requests.clear()
    there.behaviour = answers(200)
    second = a_harness(notify, state=tmp_path)
    start, end = events(there.received(2))
    assert (start["id"], end["id"]) == ("e1.started", "e1.ended")
    assert start["data"]["notification"] == {"text": "car1 brakes"}
    second.end()
    assert not second.lost
    third = a_harness(notify, state=tmp_path)
    third.end()
    assert len(there.requests) == 2
    assert not list((tmp_path / "notify").iterdir())


def test_messages_of_an_action_removed_from_its_rule_become_dead_letters(tmp_path: Path) -> None:
    with nobody() as gone:
        harness = a_harness({"http": http(gone), "events": ["Started"]}, state=tmp_path)
        harness.run(an_episode("e1"))
        harness.action.close()
    assert harness.lost[LOST] == 1
    assert [letter["event"]["id"] for letter in letters(tmp_path)] == ["e1.started"]
    assert len(list((tmp_path / "notify").iterdir())) == 1


def test_a_resumed_episode_reports_only_its_end_with_the_texts_of_its_start(there: Endpoint, tmp_path: Path) -> None:
    notify = {"http": http(there), "text": "x"}
    first = a_harness(notify, state=tmp_path)
    first.action.started(
        an_episode(
            rendered={"text": "car1 brakes"},
        )
    )
    there.received(1)
    first.end()
    second = a_harness(notify, state=tmp_path)
    second.run(an_episode(resumed=True, unrendered={"text": "it is of before the restart"}))
    end = events(there.received(2))[1]
    assert (end["id"], end["data"]["notification"]) == ("e1.ended", {"text": "car1 brakes"})
    second.outcome("e1")
    second.end()


def test_a_text_that_could_not_be_rendered_is_missing_and_reported(there: Endpoint) -> None:
    harness = a_harness({"http": http(there), "title": "t", "text": "x"})
    harness.run(an_episode(rendered={"title": "braking"}, unrendered={"text": "speed is unknown"}))
    assert events(there.received(1))[0]["data"]["notification"] == {"title": "braking"}
    assert harness.outcome("e1").message == "text: speed is unknown"
    harness.end()


def test_an_open_episode_is_complete_once_its_start_is_delivered(there: Endpoint) -> None:
    harness = a_harness({"http": http(there)})
    open_ = replace(an_episode(), ended=None, end_time=None, reason=None)
    harness.action.started(open_)
    there.received(1)
    harness.action.completed(open_, Completion(cut="the detector stops"))
    harness.outcome("e1")
    harness.end()


def test_a_secret_mounted_late_is_waited_for(there: Endpoint, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WAYSIDE_SECRETS", str(tmp_path))
    harness = a_harness({"http": {"urlSecretKeyRef": {"name": "hook", "key": "url"}}, "events": ["Started"]})
    harness.run(an_episode())
    assert "urlSecretKeyRef: the Secret hook is not mounted" in harness.outcome("e1", OutcomeState.RUNNING).message
    (tmp_path / "hook.new").mkdir()
    (tmp_path / "hook.new" / "url").write_text(f"{there.url}/T0K3N\n")
    (tmp_path / "hook.new").rename(tmp_path / "hook")
    harness.outcome("e1")
    assert there.requests[0].path == "/T0K3N"
    assert all("T0K3N" not in outcome.message for _, outcome in harness.outcomes)
    harness.end()


class Session:
    """A messenger over a real session."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session

    def publish(self, key: str, payload: bytes, encoding: str) -> None:
        self._session.put(key, payload, encoding=encoding)


def test_a_zenoh_key_gets_the_event() -> None:
    arrived: list[tuple[str, str, dict[str, Any]]] = []
    changed = threading.Event()

    def take(sample: zenoh.Sample) -> None:
        arrived.append((str(sample.key_expr), str(sample.encoding), json.loads(sample.payload.to_bytes())))
        if len(arrived) == 2:
            changed.set()

    with session("peer") as alone:
        subscriber = alone.declare_subscriber("city/alerts", take)
        harness = a_harness({"zenoh": {"key": "city/alerts"}, "title": "t"}, messenger=Session(alone))
        harness.run(an_episode(rendered={"title": "braking"}))
        assert changed.wait(PATIENCE), arrived
        harness.outcome("e1")
        harness.end()
        subscriber.undeclare()
    assert [key for key, _, _ in arrived] == ["city/alerts"] * 2
    assert {encoding for _, encoding, _ in arrived} == {"application/cloudevents+json"}
    assert [event["id"] for _, _, event in arrived] == ["e1.started", "e1.ended"]
    assert arrived[0][2]["data"]["notification"] == {"title": "braking"}
