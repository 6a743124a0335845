"""A detector process that notifies: over real Zenoh and HTTP, beside an endpoint that hangs, and across a kill -9."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.driving import a_rule
from tests.http_servers import Endpoint, Received, answers, endpoint, hangs
from tests.process.database_harness import wait_until
from tests.process.running import Process

SPEED = {"name": "v", "stream": "speed", "value": "msg.v"}


def a_notifying_rule(good: Endpoint, bad: Endpoint) -> Any:
    texts = {"title": "${client} is fast", "text": "${client} goes ${v} m/s", "labels": {"speed": "${v}"}}
    return a_rule(
        "fast",
        signals=[SPEED],
        when="v > 10",
        evaluation={"every": "100ms"},
        actions=[
            {"name": "good", "notify": {"http": {"url": good.url}, **texts}},
            {"name": "bad", "notify": {"http": {"url": bad.url, "timeout": "1m"}}},
            {"name": "city", "notify": {"zenoh": {"key": "city/alerts"}, **texts}},
        ],
    )


def events(requests: list[Received]) -> list[dict[str, Any]]:
    return [json.loads(request.body) for request in requests]


def test_a_hanging_endpoint_delays_no_other_and_gets_its_events_after_a_kill(tmp_path: Path) -> None:
    process = Process(tmp_path)
    with endpoint() as good, endpoint(hangs()) as bad:
        process.write(a_notifying_rule(good, bad), state={"path": str(tmp_path / "state")})
        process.start()
        arrived: list[str] = []
        process.vehicle.declare_subscriber("city/alerts", lambda sample: arrived.append(sample.payload.to_string()))
        process.send("car1", {"v": 20})
        (start,) = events(good.received(1))
        assert start["data"]["notification"] == {
            "title": "car1 is fast",
            "text": "car1 goes 20 m/s",
            "labels": {"speed": "20"},
        }
        bad.received(1)
        process.send("car1", {"v": 0})
        end = events(good.received(2))[1]
        assert (end["type"], end["data"]["episode"]) == ("dev.wayside.event.ended", start["data"]["episode"])
        process.status_when(lambda _: len(arrived) == 2)
        status = process.status_when(lambda status: _done(status, "good", 1) and _done(status, "city", 1))
        actions = {each.action: each for each in status.actions}
        assert (actions["bad"].running, actions["bad"].failed, actions["city"].done) == (1, 0, 1)
        process.process.kill()
        process.process.wait()
        process.vehicle.close()  # type: ignore[no-untyped-call]
        bad.requests.clear()
        bad.behaviour = answers(200)
        process.start()
        assert [event["id"] for event in events(bad.received(2))] == [start["id"], end["id"]]
        assert len(good.requests) == 2
        assert process.stop() == 0


def test_an_alert_continues_after_a_kill_with_its_labels(tmp_path: Path) -> None:
    process = Process(tmp_path)
    with endpoint() as there:
        rule = a_rule(
            "fast",
            signals=[SPEED],
            when="v > 10",
            evaluation={"every": "100ms"},
            actions=[
                {
                    "name": "am",
                    "notify": {
                        "alertmanager": {"url": there.url, "repeat": "1h"},
                        "labels": {"vehicle": "${client}"},
                    },
                }
            ],
        )
        process.write(rule, state={"path": str(tmp_path / "state")})
        process.start()
        process.send("car1", {"v": 20})
        (first,) = events(there.received(1))[0]
        # A kill loses events that are not yet on the state volume.
        wait_until(
            lambda: any(first["labels"]["episode"] in each.read_text() for each in tmp_path.glob("state/*.json"))
        )
        process.process.kill()
        process.process.wait()
        process.vehicle.close()  # type: ignore[no-untyped-call]
        process.start()
        (second,) = events(there.received(2))[1]
        assert second["labels"] == first["labels"]
        assert first["labels"]["vehicle"] == "car1"
        process.send("car1", {"v": 0})
        (third,) = events(there.received(3))[2]
        assert third["labels"] == first["labels"]
        assert third["endsAt"] < second["endsAt"]
        assert process.stop() == 0


def _done(status: Any, name: str, count: int) -> bool:
    return any(each.action == name and each.done == count for each in status.actions)
