"""Alerts fire at the start, are repeated before they expire, are resolved at the end, and keep their labels."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from detector.actions import Completion, OutcomeState
from detector.actions.notify import alerts
from tests.http_servers import Endpoint, answers, hangs, holds
from tests.notifying import a_harness, an_episode
from wayside.times import parse_time

NOBODY = "alerts that were accepted too late to notify"


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(alerts, "FIRST", 0.02)
    monkeypatch.setattr(alerts, "LONGEST", 0.1)


def notify(there: Endpoint, repeat: str = "1h", **fields: Any) -> dict[str, Any]:
    return {"alertmanager": {"url": f"{there.url}/am/", "repeat": repeat}, "waiting": 100, **fields}


def posted(there: Endpoint, count: int = 1) -> list[dict[str, Any]]:
    """The alerts of this number of requests."""
    return [alert for request in there.received(count) for alert in json.loads(request.body)]


def open_of(episode: Any) -> Any:
    return replace(episode, ended=None, end_time=None, reason=None)


def test_an_alert_fires_at_the_start_and_is_resolved_at_the_end(there: Endpoint) -> None:
    harness = a_harness(notify(there, title="t", text="x", labels={"severity": "page"}))
    episode = an_episode(rendered={"title": "braking", "text": "car1 brakes", "labels": {"severity": "page", "n": ""}})
    harness.action.started(open_of(episode))
    (first,) = posted(there)
    assert (there.requests[0].method, there.requests[0].path) == ("POST", "/am/api/v2/alerts")
    assert there.requests[0].headers["content-type"] == "application/json"
    assert first["labels"] == {
        "alertname": "braking",
        "detector": "h",
        "subject": "car1",
        "episode": "e1",
        "severity": "page",
    }
    assert first["annotations"] == {"summary": "braking", "description": "car1 brakes"}
    assert harness.outcome("e1", OutcomeState.RUNNING).message == "fires"
    harness.action.ended(episode)
    second = posted(there, 2)[1]
    assert second["labels"] == first["labels"]
    assert second["startsAt"] == first["startsAt"] == "2026-01-01T00:00:00.000000000Z"
    assert second["endsAt"] == "2026-01-01T00:00:05.000000000Z"
    assert parse_time(first["endsAt"]) - 4 * 3600 * 10**9 > parse_time(first["startsAt"])
    harness.outcome("e1")
    harness.action.completed(episode, Completion())
    harness.end()
    assert len(there.requests) == 2


def test_an_alert_is_repeated_with_a_later_end_while_its_episode_lasts(there: Endpoint) -> None:
    harness = a_harness(notify(there, repeat="50ms"))
    harness.action.started(open_of(an_episode()))
    ends = [parse_time(alert["endsAt"]) for alert in posted(there, 4)[:4]]
    assert ends == sorted(set(ends))
    harness.action.ended(an_episode())
    harness.outcome("e1")
    count = len(there.requests)
    harness.end()
    assert len(there.requests) == count


def test_many_alerts_share_a_request(there: Endpoint) -> None:
    reported = threading.Event()
    there.behaviour = holds(reported, answers(200))
    harness = a_harness(notify(there))
    harness.action.started(open_of(an_episode("e0")))
    there.received(1)
    for number in range(1, 50):
        harness.action.started(open_of(an_episode(f"e{number}", f"car{number}")))
    reported.set()
    harness.outcome("e49", OutcomeState.RUNNING)
    assert len(posted(there, 2)) == 1 + 49
    harness.end()


def test_an_alert_whose_end_comes_while_it_is_sent_as_firing_is_resolved_next(there: Endpoint) -> None:
    ended = threading.Event()
    there.behaviour = holds(ended, answers(503))
    harness = a_harness(notify(there))
    harness.action.started(open_of(an_episode()))
    there.received(1)
    harness.action.ended(an_episode())
    there.behaviour = answers(200)
    ended.set()
    first, second = posted(there, 2)
    assert parse_time(first["endsAt"]) > parse_time(second["endsAt"])
    failed = harness.outcome("e1", OutcomeState.FAILED)
    assert "accepted the alert only after the end of the episode" in failed.message
    assert harness.lost[NOBODY] == 1
    harness.end()


def test_alerts_reach_an_alertmanager_after_its_outage(there: Endpoint) -> None:
    there.behaviour = answers(503)
    harness = a_harness(notify(there))
    harness.action.started(open_of(an_episode()))
    there.received(3)
    assert harness.outcome("e1", OutcomeState.RUNNING).message == "not delivered yet: answered 503"
    there.behaviour = answers(200)
    harness.until(lambda: harness.outcomes[-1][1].message == "fires")
    harness.action.ended(an_episode())
    harness.outcome("e1")
    harness.end()
    assert not harness.lost


def test_a_rejected_resolved_alert_becomes_a_dead_letter(there: Endpoint, tmp_path: Path) -> None:
    there.behaviour = answers(400, b"bad label")
    harness = a_harness(notify(there), state=tmp_path)
    harness.action.started(open_of(an_episode()))
    harness.until(lambda: harness.lost["alerts rejected by the Alertmanager"])
    harness.action.ended(an_episode())
    assert harness.outcome("e1", OutcomeState.FAILED).message == "not delivered: answered 400: bad label"
    (file,) = (tmp_path / "notify").glob("*.dead.jsonl")
    assert json.loads(file.read_text())["event"]["id"] == "e1.ended"
    harness.end()


def test_alerts_beyond_the_limit_become_dead_letters(there: Endpoint) -> None:
    there.behaviour = hangs()
    harness = a_harness(notify(there) | {"waiting": 2})
    for number in range(3):
        harness.action.started(open_of(an_episode(f"e{number}")))
    assert "the queue is full" in harness.outcome("e2", OutcomeState.FAILED).message
    harness.end()


def test_at_shutdown_resolved_alerts_are_sent_and_firing_ones_are_left_to_the_next_run(there: Endpoint) -> None:
    there.behaviour = answers(503, Retry_After="60")
    harness = a_harness(notify(there))
    harness.action.started(open_of(an_episode("over")))
    there.received(1)
    harness.outcome("over", OutcomeState.RUNNING)
    harness.action.started(open_of(an_episode("open")))
    harness.action.ended(an_episode("over"))
    there.behaviour = answers(200)
    harness.end()
    reported = {alert["labels"]["episode"]: alert for alert in json.loads(there.requests[-1].body)}
    assert reported["over"]["endsAt"] == "2026-01-01T00:00:05.000000000Z"
    assert parse_time(reported["open"]["endsAt"]) > parse_time(reported["over"]["endsAt"])
    assert "had not ended" in harness.outcome("open").message
    assert len(there.requests) == 2


def test_a_resumed_episode_keeps_its_labels(there: Endpoint, tmp_path: Path) -> None:
    rule = notify(there, labels={"road": "${road}"})
    first = a_harness(rule, state=tmp_path)
    first.action.started(open_of(an_episode(rendered={"labels": {"road": "A1"}})))
    there.received(1)
    first.end()
    second = a_harness(rule, state=tmp_path)
    second.action.started(open_of(an_episode(resumed=True, unrendered={"labels": "it is of before the restart"})))
    before, after = posted(there, 2)
    assert before["labels"] == after["labels"]
    assert before["labels"]["road"] == "A1"
    second.end()
