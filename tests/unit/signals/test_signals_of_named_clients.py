"""Signals over the samples or episodes of a client that they name: the same for every subject."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from tests.driving import POSITION, SPEED, Drive, a_detector, a_rule, a_stream, arrival, compiled, place
from wayside.rules import RuleError

LIGHT = {"name": "light", "stream": "state", "client": "light-3", "value": "msg.v"}
DETECTOR = a_detector(a_stream("speed"), a_stream("pose"), a_stream("state", staleAfter="2s"), clientTimeout="3s")


def light(seconds: float, value: Any) -> Any:
    return arrival(seconds, "light-3", {"v": value}, "state")


def speed(seconds: float, client: str, value: float) -> Any:
    return arrival(seconds, client, {"v": value})


RED = a_rule("red", signals=[SPEED, LIGHT], when="speed > 1 && light == 'red'", evaluation={"every": "100ms"})


def test_every_vehicle_that_drives_during_a_red_light_is_found() -> None:
    drive = Drive(DETECTOR, RED)
    assert drive.engine.in_columns == {"red"}
    reported = drive.take(
        speed(0.1, "a", 5), light(0.2, "green"), speed(0.3, "b", 0), light(0.4, "red"), speed(0.5, "b", 2), until=0.5
    )
    assert reported == ["red a started 0.4", "red b started 0.5"]
    assert drive.take(light(0.6, "green"), until=0.7) == ["red a Until 0.6", "red b Until 0.6"]


def test_the_signal_is_unknown_while_stale_or_while_its_client_is_unknown() -> None:
    count = {**LIGHT, "name": "reds", "over": "5s", "aggregate": "Count", "where": "msg.v == 'red'"}
    count.pop("value")
    never = a_rule("never", signals=[SPEED, count], when="speed > 1 && reds == 0", evaluation={"every": "1s"})
    drive = Drive(DETECTOR, RED, never)
    assert drive.take(*(speed(n / 2, "a", 5) for n in range(1, 4)), until=1.9) == []  # the light is not known yet
    reported = drive.take(light(2.5, "green"), *(speed(n / 2, "a", 5) for n in range(5, 9)), until=4)
    assert reported == ["never a started 3"]
    reported = drive.take(light(4.1, "red"), *(speed(n / 2, "a", 5) for n in range(9, 20)), until=9.9)
    assert reported == ["red a started 4.1", "never a Until 5", "red a Unknown 9.2"]
    assert "light-3" not in drive.engine.clients


def test_pairs_fleets_and_episodes_see_the_signal_too() -> None:
    pairs = {"pairs": {"position": POSITION, "within": 50}}
    near = a_rule("near", scope=pairs, signals=[LIGHT], when="distance < 10 && a.light == 'red' && b.light == 'red'")
    fleet = {"fleet": {"members": "speed > 1"}}
    many = a_rule("many", scope=fleet, signals=[SPEED, LIGHT], when="members.exists(m, m.light == 'red')")
    phase = a_rule("phase", signals=[{**LIGHT, "client": None}], when="light == 'red'")
    active = {"name": "on", "ruleName": "phase", "client": "light-3", "aggregate": "Active"}
    stop = a_rule("stop", signals=[active, SPEED], when="on && speed > 1")
    drive = Drive(DETECTOR, near, many, phase, stop)
    reported = drive.take(place(0.1, "a", 0), place(0.2, "b", 3), speed(0.3, "a", 5), light(0.4, "red"), until=1)
    expected = ["many ~fleet started 1", "near a+b started 1", "phase light-3 started 1", "stop a started 1"]
    assert sorted(reported) == expected


@pytest.mark.parametrize(
    ("signal", "problem"),
    [
        (
            {"name": "s", "plugin": {"name": "p"}, "client": "a"},
            "client is valid only with stream or ruleName: remove it",
        ),
        ({"name": "s", "stream": "speed", "value": "msg.v", "client": "a b"}, "client"),
    ],
)
def test_a_client_is_named_for_a_stream_or_a_rule(signal: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValidationError, match=problem):
        a_rule(signals=[signal], when="s")


def test_a_client_that_cannot_send_the_stream_is_rejected_by_field() -> None:
    detector = a_detector({"name": "state", "key": "lights/state", "encoding": "json", "client": "light-1"})
    with pytest.raises(
        RuleError, match=r"signals\[0\].client: stream state has only the client light-1: write client: light-1"
    ):
        compiled(detector, a_rule(signals=[LIGHT], when="light == 'red'"))
