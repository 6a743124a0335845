"""A rule starts recordings through an HTTP endpoint: real requests to real servers, also misbehaving ones."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from detector.actions import (
    ActionContext,
    ActionError,
    Completion,
    DetectorConfiguration,
    Episode,
    Outcome,
    OutcomeState,
)
from detector.actions.trigger.action import Trigger
from detector.assembly import stream_readers
from tests.driving import a_detector, a_rule
from tests.http_servers import answers, endpoint, hangs
from tests.patience import PATIENCE
from wayside.api.actions import trigger as api


class NoMessenger:
    """A messenger for actions that use no Zenoh."""

    def publish(self, key: str, payload: bytes, encoding: str) -> None:
        raise AssertionError(key)

    def query(
        self, selector: str, payload: bytes | None, timeout: float, attachment: bytes | None = None
    ) -> list[bytes]:
        raise ActionError(f"{selector}: nobody answered")


class DrivenAction:
    """The action as its host calls it, on this thread."""

    def __init__(self, trigger: dict[str, Any], state: Path | None = None) -> None:
        spec = {} if state is None else {"state": {"path": str(state)}}
        detector = a_detector(**spec)
        configuration = DetectorConfiguration(
            detector, stream_readers(detector).decoders, stream_readers(detector).types
        )
        self.outcomes: list[Outcome] = []
        self.lost: list[str] = []
        self.closing = threading.Event()
        self.parameters = api.TriggerAction.model_validate(trigger)
        rule = a_rule("r", when="true", actions=[{"name": "other", "trigger": trigger}])
        self.context = ActionContext(
            rule=rule,
            action="other",
            holder="h",
            configuration=lambda: configuration,
            messenger=NoMessenger(),
            report=lambda _, outcome: self.outcomes.append(outcome),
            lose=lambda what, count, why: self.lost.append(f"{count} {what}: {why}"),
            closing=self.closing,
        )
        self.action = Trigger(self.parameters, self.context)

    def until(self, done: Any) -> None:
        deadline = time.monotonic() + PATIENCE
        while not done():
            assert time.monotonic() < deadline, self.outcomes
            time.sleep(min(self.action.wake() or 0.01, 0.05))

    def finished(self) -> Outcome:
        self.until(lambda: self.outcomes and self.outcomes[-1].state is not OutcomeState.RUNNING)
        return self.outcomes[-1]

    def recording(self) -> bool:
        return any("Recording" in outcome.message for outcome in self.outcomes)


def an_episode(parameters: api.TriggerAction, **fields: Any) -> Episode:
    now = time.time_ns()
    given: dict[str, Any] = {
        "id": "e1", "rule": "r", "subject": "car1", "clients": ("car1",), "element": None, "onset_time": now,
        "start_time": now, "values": {"v": 3.0}, "classification": None, "rendered": parameters.templates,
        "unrendered": {}, "started": {"id": "e1.started", "subject": "car1"},
    }  # fmt: skip
    return Episode(**{**given, **fields})


def http(url: str, timeout: str = "30s", **fields: Any) -> dict[str, Any]:
    calls = {
        "start": {"method": "PUT", "url": f"{url}/recordings/{{id}}"},
        "stop": {"method": "DELETE", "url": f"{url}/recordings/{{id}}"},
    }
    return {"http": {**calls, "timeout": timeout}, **fields}


def end(episode: Episode) -> Episode:
    return replace(episode, end_time=time.time_ns(), reason="Until", ended={})


def test_an_endpoint_is_called_at_the_start_and_at_the_end() -> None:
    with endpoint() as there:
        driven = DrivenAction(http(there.url, maxDuration="5m"))
        episode = an_episode(driven.parameters)
        driven.action.started(episode)
        driven.until(driven.recording)
        driven.action.ended(end(episode))
        driven.action.completed(end(episode), Completion())
        assert driven.finished().state is OutcomeState.DONE
        first, last = there.received(2)
    assert (first.method, last.method) == ("PUT", "DELETE")
    identity = first.path.rsplit("/", 1)[1]
    assert identity.startswith("h.r.other.")
    assert first.headers["idempotency-key"] == f"{identity}.start"
    assert last.headers["idempotency-key"] == f"{identity}.stop"
    assert json.loads(first.body) == {
        "id": identity,
        "do": "start",
        "maxDuration": "5m",
        "event": {"id": "e1.started", "subject": "car1"},
    }


def test_a_custom_body_is_sent_as_rendered() -> None:
    with endpoint() as there:
        call = {"url": f"{there.url}/snap", "body": {"vehicle": "${client}", "speed": "${v}"}}
        driven = DrivenAction({"http": {"stop": call}})
        rendered = {"http": {"stop": {"body": {"vehicle": "car1", "speed": 3.0}}}}
        episode = an_episode(driven.parameters, rendered=rendered)
        driven.action.started(episode)
        driven.action.ended(end(episode))
        driven.finished()
        (request,) = there.requests
    assert json.loads(request.body) == {"vehicle": "car1", "speed": 3.0}


@pytest.mark.parametrize("fault", [answers(500), answers(503, Retry_After="1"), hangs()], ids=["500", "busy", "hangs"])
def test_a_failed_request_is_retried_with_the_same_idempotency_key(fault: Any) -> None:
    with endpoint(fault) as there:
        driven = DrivenAction(http(there.url, "1s"))
        episode = an_episode(driven.parameters)
        driven.action.started(episode)
        driven.until(lambda: any("start is not confirmed yet" in outcome.message for outcome in driven.outcomes))
        there.behaviour = answers()
        driven.until(driven.recording)
        keys = {request.headers["idempotency-key"] for request in there.requests}
        assert len(keys) == 1
        there.behaviour = fault
        driven.action.ended(end(episode))
        driven.until(lambda: any("stop is not confirmed yet" in outcome.message for outcome in driven.outcomes))
        there.behaviour = answers(404)  # the first stop had arrived: no recording is left
        assert driven.finished().state is OutcomeState.DONE
    assert driven.lost == []


def test_a_permanently_rejected_start_is_not_retried() -> None:
    with endpoint(answers(403, b"not you")) as there:
        driven = DrivenAction(http(there.url))
        driven.action.started(an_episode(driven.parameters))
        outcome = driven.finished()
        assert outcome.state is OutcomeState.FAILED
        assert outcome.message == f"http://localhost:{there.port} answered 403: not you"
        assert len(there.requests) == 1


def test_a_stop_that_is_never_confirmed_is_counted() -> None:
    with endpoint() as there:
        driven = DrivenAction(http(there.url, giveUpAfter="1s"))
        episode = an_episode(driven.parameters)
        driven.action.started(episode)
        driven.until(driven.recording)
        there.behaviour = answers(500)
        driven.action.ended(end(episode))
        assert driven.finished().state is OutcomeState.FAILED
        assert "gave up waiting for the confirmation of the stop" in driven.outcomes[-1].message
    (lost,) = driven.lost
    assert lost.startswith(
        "1 recordings on other systems whose stop was not confirmed: their maxDuration ends them: h.r."
    )


def test_a_recording_ends_after_its_max_duration_also_while_the_episode_lasts() -> None:
    with endpoint() as there:
        driven = DrivenAction(http(there.url, maxDuration="1s"))
        driven.action.started(an_episode(driven.parameters))
        outcome = driven.finished()
        assert [request.method for request in there.requests] == ["PUT", "DELETE"]
    assert (outcome.state, outcome.message) == (
        OutcomeState.DONE,
        "the recording reached its maxDuration before the episode ended",
    )


def test_at_shutdown_a_recording_that_cannot_be_restored_is_stopped() -> None:
    with endpoint() as there:
        driven = DrivenAction(http(there.url))
        episode = an_episode(driven.parameters)
        driven.action.started(episode)
        driven.until(driven.recording)
        driven.closing.set()
        driven.action.completed(episode, Completion("the detector stopped"))
        driven.action.close()
        assert [request.method for request in there.requests] == ["PUT", "DELETE"]
    assert driven.outcomes[-1].state is OutcomeState.DONE


def test_a_restored_recording_continues_and_is_stopped_by_the_next_run(tmp_path: Path) -> None:
    """The journal keeps the rendered requests, the only data that the next run has."""
    with endpoint() as there:
        trigger = http(there.url)
        trigger["http"]["stop"] = {"url": f"{there.url}/stop", "body": {"who": "${client}"}}
        driven = DrivenAction(trigger, tmp_path)
        rendered = {"http": {"stop": {"body": {"who": "car1"}}}}
        episode = an_episode(driven.parameters, rendered=rendered)
        driven.action.started(episode)
        driven.until(driven.recording)
        driven.closing.set()
        driven.action.completed(episode, Completion("the detector stopped"))
        driven.action.close()
        assert [request.method for request in there.requests] == ["PUT"]

        following = DrivenAction(trigger, tmp_path)
        unrendered = {"http": "it needs values from before the detector's restart"}
        resumed = an_episode(following.parameters, rendered={}, unrendered=unrendered, resumed=True)
        following.action.started(resumed)
        following.until(following.recording)
        following.action.ended(end(resumed))
        assert following.finished().state is OutcomeState.DONE
        assert [request.method for request in there.requests] == ["PUT", "PUT", "POST"]
        keys = [request.headers["idempotency-key"] for request in there.requests]
        assert keys[0] == keys[1]
        assert json.loads(there.requests[-1].body) == {"who": "car1"}
    following.action.close()
    assert not list((tmp_path / "triggers").iterdir())


def test_a_changed_rule_leaves_the_recordings_of_its_running_episodes_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The action with its old rule ends them, although the one with the new rule has the same parameters."""
    monkeypatch.setattr("detector.actions.trigger.action._CLAIM", 0.0)
    with endpoint() as there:
        before = DrivenAction(http(there.url), tmp_path)
        episode = an_episode(before.parameters)
        before.action.started(episode)
        before.until(before.recording)
        after = DrivenAction(http(there.url), tmp_path)
        assert after.action.wake() is None
        assert [request.method for request in there.requests] == ["PUT"]
        before.action.ended(end(episode))
        assert before.finished().state is OutcomeState.DONE
        for each in (before, after):
            each.action.close()
    assert not list((tmp_path / "triggers").iterdir())


def test_an_unwritable_state_folder_is_counted_and_affects_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "triggers").write_text("a file where a folder should be")
    with endpoint() as there:
        driven = DrivenAction(http(there.url), tmp_path)
        driven.action.started(an_episode(driven.parameters))
        driven.until(driven.recording)
    (lost,) = driven.lost
    assert lost.startswith(f"1 recordings on other systems that a restart would not stop: cannot use {tmp_path}")


def test_a_dead_endpoint_gets_one_attempt_at_a_time() -> None:
    """Fifty episodes share one timeout instead of waiting for one each."""
    with endpoint(hangs()) as there:
        driven = DrivenAction(http(there.url, "1s"))
        for number in range(50):
            driven.action.started(an_episode(driven.parameters, id=f"e{number}"))
        begin = time.monotonic()
        driven.until(lambda: len(there.requests) >= 2)
        assert time.monotonic() - begin < 20
        there.behaviour = answers()
        driven.until(lambda: len({request.path for request in there.requests}) == 50)


@pytest.mark.parametrize(
    ("fields", "reported"),
    [
        ({}, "give start, stop or both"),
        ({"start": {"url": "https://${client}/x"}}, "must not contain"),
    ],
)
def test_invalid_settings_are_rejected(fields: dict[str, Any], reported: str) -> None:
    with pytest.raises(ValueError, match=reported):
        api.TriggerAction.model_validate({"http": fields})
