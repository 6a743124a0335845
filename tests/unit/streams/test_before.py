"""`before`: the sample before of the same client and stream, beside `msg` or `item`."""

from __future__ import annotations

import json
from typing import Any

import pytest

from detector.assembly import stream_readers
from detector.engine.samples.sample import Arrival
from tests.driving import SECOND, START, Drive, a_detector, a_rule, a_stream, arrival, at, place
from tests.guides import guide
from tests.ros_messages import cdr, pose_stamped
from wayside.api import EventRule
from wayside.rules import RuleError, compile_rule

CROSSING = "before.x < 10 && msg.x >= 10"


def jump(value: str = "msg.x - before.x", **spec: Any) -> EventRule:
    signals = [{"name": "jump", "stream": "pose", "value": value, "over": "1s", "aggregate": "Max"}]
    return a_rule("jump", signals=signals, when="jump > 5", **{"evaluation": {"every": "100ms"}, **spec})


@pytest.mark.parametrize("evaluation", [{"every": "100ms"}, {"onSample": "pose"}])
def test_a_jump_and_the_crossing_of_a_line_are_expressions_over_two_samples(evaluation: dict[str, str]) -> None:
    assert CROSSING in guide("rules")
    crossing = a_rule(
        "crossing", signals=[{"name": "now", "stream": "pose", "value": CROSSING}], when="now", evaluation=evaluation
    )
    drive = Drive(a_detector(), jump(evaluation=evaluation), crossing)
    assert drive.engine.in_columns == {"jump", "crossing"}
    ways = [(1, "car", 8), (2, "car", 9), (2, "bus", 50), (3, "car", 11), (4, "car", 12), (4, "bus", 56), (5, "car", 4)]
    events = drive.take(*(place(n / 10, client, x) for n, client, x in ways), until=0.5)
    assert events == ["crossing car started 0.3", "crossing car Until 0.4", "jump bus started 0.4"]
    assert drive.engine.counters.rule("crossing").errors == 0


def test_the_first_sample_and_one_after_a_pause_have_no_sample_before() -> None:
    drive = Drive(a_detector(a_stream("pose", staleAfter="2s")), jump())
    assert drive.take(place(0.5, "car", 50), until=1) == []
    assert drive.take(place(2.6, "car", 90), until=3) == []  # 2.1 s later
    assert drive.take(place(4.6, "car", 99), until=5) == ["jump car started 4.6"]
    counters = drive.engine.counters.rule("jump")
    assert counters.errors == 0
    assert counters.absences["no value for `before`"] >= 2


def test_an_undecodable_message_does_not_count_as_the_sample_before() -> None:
    drive = Drive(a_detector(a_stream("pose")), jump())
    reported = drive.take(place(0.1, "car", 1), arrival(0.2, "car", b"{", "pose"), place(0.3, "car", 90), until=0.5)
    assert reported == []
    assert drive.take(place(0.6, "car", 99), until=0.7) == ["jump car started 0.6"]
    assert drive.engine.counters.undecodable["pose"] == 1


def test_an_item_is_compared_with_the_item_before_of_the_same_client() -> None:
    key = "stations/${station:*}/list"
    items = {"items": "msg.list", "client": "${item.id}", "staleAfter": "1s"}
    detector = a_detector({"name": "pose", "key": key, "encoding": "json", **items})

    def sent(seconds: float, **places: float) -> Arrival:
        payload = json.dumps({"list": [{"id": name, "x": x} for name, x in places.items()]}).encode()
        return Arrival(at(seconds), "pose", "stations/n/list", payload)

    drive = Drive(detector, jump("item.x - before.x"))
    assert drive.take(sent(0.1, a=1, b=50), sent(0.2, b=51, a=9), until=0.2) == ["jump a started 0.2"]
    # Another object under the same name has none before.
    assert drive.take(sent(1.0, b=51), sent(2.9, a=90), until=3) == ["jump a ClientLost 1.3"]
    assert drive.take(sent(3.2, a=99), until=3.3) == ["jump a started 3.2"]


def test_a_late_sample_does_not_change_the_sample_before_of_others() -> None:
    detector = a_detector(a_stream("pose", stamp="msg.t"), clock="Data", lateness="200ms")
    drive = Drive(detector, jump(evaluation={"every": "100ms"}))

    def sent(received: float, stamp: float, x: float) -> Arrival:
        payload = json.dumps({"t": (START + round(stamp * SECOND)) / SECOND, "x": x}).encode()
        return Arrival(at(received), "pose", "vehicles/car/pose", payload)

    drive.take(sent(0.1, 0.1, 1), sent(0.2, 0.2, 2), sent(0.4, 0.4, 3), sent(1, 1, 3), until=0)
    reported = drive.take(sent(1.1, 0.3, -9), sent(1.2, 1.3, 4), until=0) + drive.finish()
    assert reported == []  # 3 - -9 would be a jump, had it been there in time


def test_messages_of_ros_are_compared_by_their_fields() -> None:
    stream = a_stream("pose", encoding="cdr", type="geometry_msgs/msg/PoseStamped")
    drive = Drive(a_detector(stream), jump("msg.pose.position.x - before.pose.position.x"))
    payloads = [cdr(pose_stamped(x)) for x in (1.0, 2.0, 9.0)]
    arrivals = [arrival(n / 10, "car", payload, "pose") for n, payload in enumerate(payloads, start=1)]
    assert drive.take(*arrivals, until=0.5) == ["jump car started 0.3"]


@pytest.mark.parametrize(
    ("rule", "problem"),
    [
        (jump("msg.pose.position.x - before.poses.x"), r"value: before has no field poses; did you mean pose\?"),
        (
            a_rule(signals=[{"name": "s", "ruleName": "r", "value": "before.subject"}], when="s == 'car'"),
            r"value: .*`before` is not declared here.*; before is for signals over streams, not over a rule",
        ),
        (
            jump(each={"as": "before", "of": [{"name": "n"}]}),
            r"each.as: a sample already defines the variable before: the message or item before",
        ),
    ],
)
def test_errors_of_expressions_over_two_samples_are_reported_by_field(rule: EventRule, problem: str) -> None:
    detector = a_detector(a_stream("pose", encoding="cdr", type="geometry_msgs/msg/PoseStamped"))
    with pytest.raises(RuleError, match=problem):
        compile_rule(rule, detector, stream_readers(detector).fields)
