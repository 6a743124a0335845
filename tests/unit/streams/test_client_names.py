"""Clients named by their messages: `client` of a stream is a template over msg."""

from __future__ import annotations

from typing import Any

import pytest

from detector.assembly import DetectorError, stream_readers
from detector.engine.samples.sample import Arrival
from detector.streams.codecs.etsi.quantities import its_ms
from tests.driving import Drive, a_detector, a_rule, at
from tests.unit.encodings.its_messages import a_cam

FAST = {
    "signals": [{"name": "speed", "stream": "speed", "value": "msg.v"}],
    "when": "speed > 10",
    "evaluation": {"every": "1s"},
}


def a_stream(client: str = "its-${msg.id}", **fields: Any) -> dict[str, Any]:
    return {"name": "speed", "key": "all/speeds", "encoding": "json", "client": client, **fields}


def sent(seconds: float, text: str, key: str = "all/speeds", stream: str = "speed") -> Arrival:
    return Arrival(at(seconds), stream, key, text.encode())


@pytest.mark.parametrize("clock", ["Wall", "Data"])
def test_the_messages_of_one_key_belong_to_the_clients_that_they_name(clock: str) -> None:
    drive = Drive(a_detector(a_stream(), clock=clock, lateness="0ms"), a_rule(**FAST))
    events = drive.take(
        sent(0.5, '{"id": 1, "v": 5}'), sent(0.6, '{"id": 2, "v": 15}'), sent(0.7, '{"id": 3, "v": 16}'), until=1
    )
    events += drive.take(sent(1.1, '{"id": 2, "v": 5}'), sent(1.2, '{"id": 1, "v": 17}'), sent(2, '{"id": 3}'), until=2)
    events += drive.finish()
    assert events == ["r its-2 started 1", "r its-3 started 1", "r its-1 started 2", "r its-2 Until 2"]
    assert drive.engine.counters.samples["speed"] == 6


def test_the_template_sees_the_captures_of_the_key_too() -> None:
    stream = a_stream("${key.site}.${msg.id}", key="all/${site:*}/speeds")
    drive = Drive(a_detector(stream), a_rule(**FAST))
    assert drive.take(sent(0.5, '{"id": 4, "v": 11}', "all/north/speeds"), until=1) == ["r north.4 started 1"]


@pytest.mark.parametrize("clock", ["Wall", "Data"])
def test_messages_without_a_valid_name_are_dropped_and_counted_with_the_reason(clock: str) -> None:
    drive = Drive(a_detector(a_stream("${msg.id}"), clock=clock), a_rule(**FAST))
    counters = drive.engine.counters
    for index, (text, reason) in enumerate(
        [
            ('{"v": 50}', "all/speeds: client: "),
            ('{"id": "a b", "v": 50}', "client: must have 1 to 63 of A-Z a-z 0-9 . _ : -, not dots alone; got 'a b'"),
            ('{"id": "", "v": 50}', "all/speeds: client: must have 1 to 63"),
            ('{"id": {"x": 1}, "v": 50}', "client: must have 1 to 63"),
        ]
    ):
        assert drive.take(sent(index + 0.5, text), until=index + 1) == []
        assert counters.unnamed["speed"] == index + 1
        assert reason in counters.last_unnamed["speed"]
    assert counters.samples["speed"] == 0
    drive.take(sent(9, "no json"), until=10)
    assert counters.undecodable["speed"] == 1
    assert counters.last_undecodable["speed"].startswith("all/speeds: not JSON")
    assert len(drive.engine.clients) == 0


def test_a_client_named_by_its_messages_is_lost_and_comes_back() -> None:
    drive = Drive(a_detector(a_stream(), clientTimeout="3s"), a_rule(**FAST))
    assert drive.take(sent(0.5, '{"id": 1, "v": 15}'), until=1) == ["r its-1 started 1"]
    assert drive.take(until=5) == ["r its-1 ClientLost 4"]
    assert drive.take(sent(5.5, '{"id": 1, "v": 15}'), until=6) == ["r its-1 started 6"]


@pytest.mark.parametrize(
    ("client", "problem"),
    [
        ("its-${msg.id", "client: .*not closed"),
        ("its-${mgs.id}", "client: .*mgs"),
        ("${1 +}", "client: line 1, column 6: the expression is incomplete"),
    ],
)
def test_a_template_that_does_not_compile_is_reported_with_its_field(client: str, problem: str) -> None:
    with pytest.raises(DetectorError, match=r"spec.streams\[0\]." + problem):
        stream_readers(a_detector(a_stream(client)))


def test_a_template_that_reads_a_member_of_a_number_is_reported_with_the_number() -> None:
    drive = Drive(a_detector(a_stream("${msg.hdr.id}")), a_rule(**FAST))
    drive.take(sent(0.5, '{"hdr": 3}'), until=1)
    reported = "`msg.hdr` is 3.0, which has no field `id`: correct the path"
    assert reported in drive.engine.counters.last_unnamed["speed"]


def test_a_member_of_a_raw_message_is_refused() -> None:
    with pytest.raises(DetectorError, match=r"spec.streams\[0\].client: msg has no field id: it is bytes; read"):
        stream_readers(a_detector(a_stream(encoding="raw")))


def test_a_field_that_the_message_type_does_not_have_is_reported() -> None:
    stream = {"name": "o", "key": "odom", "encoding": "cdr", "type": "nav_msgs/msg/Odometry", "client": "${msg.child}"}
    with pytest.raises(DetectorError, match=r"spec.streams\[0\].client: msg has no field child; it has child_frame_id"):
        stream_readers(a_detector(stream))


EMERGENCY = {
    "signals": [
        {
            "name": "lightbar",
            "stream": "cam",
            "value": '"lightBarActivated" in msg.cam.camParameters.specialVehicleContainer.emergencyContainer'
            ".lightBarSirenInUse",
            "where": "has(msg.cam.camParameters.specialVehicleContainer.emergencyContainer)",
            "over": "3s",
            "aggregate": "Any",
        },
        {
            "name": "latitude",
            "stream": "cam",
            "value": "msg.cam.camParameters.basicContainer.referencePosition.latitude",
        },
    ],
    "when": "lightbar && latitude > 50.7 && latitude < 50.8",
    "evaluation": {"every": "1s"},
}


@pytest.mark.parametrize("clock", ["Wall", "Data"])
def test_an_emergency_vehicle_is_detected_by_its_cams(clock: str) -> None:
    stream = {
        "name": "cam",
        "key": "its/cam",
        "encoding": "uper",
        "type": "etsi/cam",
        "client": "its-${msg.header.stationId}",
    }
    drive = Drive(a_detector(stream, clock=clock, lateness="0ms", maxAhead="10s"), a_rule("emergency", **EMERGENCY))

    def cam(seconds: float, station: int, **fields: Any) -> Arrival:
        payload = a_cam(station=station, milliseconds=its_ms(at(seconds)), **fields)
        delay = 0.01 if clock == "Data" else 0  # the time is then the sender's, however late a message comes
        return Arrival(at(seconds + delay), "cam", "its/cam", payload)

    events = drive.take(
        cam(0.2, 4294967295, lightbar=True),
        cam(0.3, 17, lightbar=False),
        cam(0.4, 18, lightbar=True, latitude=49.0),
        cam(1.001, 19),
        until=1,
    )
    assert events == ["emergency its-4294967295 started 1"]
    events = drive.take(cam(1.5, 4294967295), cam(4.0, 17, lightbar=True), until=4) + drive.finish()
    assert events == ["emergency its-17 started 4", "emergency its-4294967295 Until 4"]
