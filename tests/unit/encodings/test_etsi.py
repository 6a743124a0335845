"""ETSI ITS messages: against pycrate's encoder, in SI units, with null for what is unavailable."""

from __future__ import annotations

import random
import subprocess
import sys
from typing import Any

import pytest

from detector.assembly import DetectorError, stream_readers
from detector.engine.samples.sample import DecodeError
from detector.streams.codecs.etsi import DefinitionError, EtsiDecoder
from detector.streams.codecs.etsi.messages import BY_NAME, packaged_definitions
from detector.streams.codecs.etsi.quantities import its_ms, nearest_time, unix_ns
from tests.driving import a_detector, a_rule
from tests.unit.encodings.its_messages import PDUS, a_cam, encode, random_message
from wayside.rules import RuleError, compile_rule

SECOND = 10**9
NOW = 1_767_225_600 * SECOND


def test_a_cam_is_a_map_in_si_units_with_null_for_what_is_unavailable() -> None:
    message = EtsiDecoder("etsi/cam").decode(a_cam(lightbar=True))
    assert message["header"] == {"protocolVersion": 2.0, "messageId": 2.0, "stationId": 4711.0}
    assert message["cam"]["generationDeltaTime"] == 12.345
    parameters = message["cam"]["camParameters"]
    assert parameters["basicContainer"] == {
        "stationType": 10.0,
        "referencePosition": {
            "latitude": 50.777321,
            "longitude": 6.1234567,
            "positionConfidenceEllipse": {
                "semiMajorConfidence": 1.0,
                "semiMinorConfidence": None,
                "semiMajorOrientation": 90.0,
            },
            "altitude": {"altitudeValue": None, "altitudeConfidence": None},
        },
    }
    moving = parameters["highFrequencyContainer"]["basicVehicleContainerHighFrequency"]
    assert moving["speed"] == {"speedValue": 13.89, "speedConfidence": None}
    assert moving["heading"] == {"headingValue": 123.4, "headingConfidence": 1.0}
    assert moving["yawRate"]["yawRateValue"] == -1.5
    assert moving["accelerationControl"] == ["brakePedalEngaged", "speedLimiterEngaged"]
    special = parameters["specialVehicleContainer"]
    assert special == {"emergencyContainer": {"lightBarSirenInUse": ["lightBarActivated"]}}


@pytest.mark.parametrize("name", PDUS)
def test_any_message_encoded_by_pycrate_is_decoded_equally(name: str) -> None:
    decoder = EtsiDecoder("etsi/" + name.split(maxsplit=1)[0])
    for seed in range(60):
        raw, expected = random_message(name, random.Random(f"{name}{seed}"))
        assert decoder.decode(raw) == expected, seed


def test_a_stream_without_a_type_accepts_all_messages_and_one_with_a_type_only_its_own() -> None:
    denm, _ = random_message("denm", random.Random(1))
    assert "denm" in EtsiDecoder().decode(denm)
    with pytest.raises(DecodeError, match=r"message 1 \(etsi/denm\), but the stream is of etsi/cam"):
        EtsiDecoder("etsi/cam").decode(denm)


def test_an_unknown_type_is_refused_with_those_that_are_known() -> None:
    with pytest.raises(DefinitionError, match=r"'etsi/camm': the known types are etsi/denm, etsi/cam, "):
        EtsiDecoder("etsi/camm")


@pytest.mark.parametrize(
    ("milliseconds", "unix"),
    [
        (0, 1_072_915_200),
        (94_694_401_000, 1_167_609_600),  # the example of TS 102 894-2: 2007-01-01T00:00:00Z
        (its_ms(NOW), 1_767_225_600),
    ],
)
def test_its_time_counts_leap_seconds(milliseconds: int, unix: int) -> None:
    assert unix_ns(milliseconds) == unix * SECOND
    assert its_ms(unix * SECOND) == milliseconds


@pytest.mark.parametrize("late", [0, 1, 300, 32_000, -300, -32_000])
def test_a_generation_time_is_the_one_nearest_to_the_receipt(late: int) -> None:
    sent = NOW + 123_000_000
    assert nearest_time(its_ms(sent) % 65536, sent + late * 1_000_000) == sent
    assert EtsiDecoder("etsi/cam").stamp_near(a_cam(milliseconds=its_ms(sent)), sent + late * 1_000_000) == sent


def test_messages_of_another_encoder_are_read() -> None:
    """Those that the tests of GeoNetworking and CAM/DENM in Java (github.com/alexvoronov/geonetworking) expect."""
    decoder = EtsiDecoder()
    read = [decoder.decode(bytes.fromhex(raw)) for raw in PUBLISHED]
    position = read[0]["cam"]["camParameters"]["basicContainer"]["referencePosition"]
    assert (position["latitude"], position["longitude"]) == (57e-7, 13e-7)
    parameters = [message["cam"]["camParameters"] for message in read[:2]]
    for each in parameters:
        moving = each["highFrequencyContainer"]["basicVehicleContainerHighFrequency"]
        assert moving["accelerationControl"] == ["gasPedalEngaged", "accEngaged"]
        assert len(each["lowFrequencyContainer"]["basicVehicleContainerLowFrequency"]["pathHistory"]) == 2
    assert parameters[0]["specialVehicleContainer"]["publicTransportContainer"] == {
        "embarkationStatus": True,
        "ptActivation": {"ptActivationType": 0.0, "ptActivationData": b"\x0a\xff"},
    }
    works = parameters[1]["specialVehicleContainer"]["roadWorksContainerBasic"]
    assert works["closedLanes"]["drivingLaneStatus"] == [False, True, False, True, False, True]
    assert read[2]["denm"]["management"]["validityDuration"] == 600.0


PUBLISHED = (
    "01020000000000646006B49D272D693A41BFFFFFFC23B7743E40E11FDFFFFEBFE9ED0737530F5FFFB09000013FFFFFFFFF1CE3FFFFFFFFF1"
    "CE060010AFF0",
    "01020000000000646006B49D272D693A41BFFFFFFC23B7743E40E11FDFFFFEBFE9ED0737530F5FFFB09000013FFFFFFFFF1CE3FFFFFFFFF1"
    "CE1A0AA8",
    "010100000000010000000000000000000000000000000006B49D201D693A401FFFFFFE11DBBA1F012C0000",
)


@pytest.mark.parametrize(
    ("raw", "seconds"),
    [
        (lambda chance: random_message("denm", chance), lambda read: read["denm"]["management"]["referenceTime"]),
        (lambda chance: random_message("mapem", chance), lambda read: None),
    ],
)
def test_messages_have_a_stamp_only_if_they_contain_the_whole_time(raw: Any, seconds: Any) -> None:
    message, expected = raw(random.Random(3))
    wanted = seconds(expected)
    assert EtsiDecoder().stamp_near(message, NOW) == (None if wanted is None else round(wanted * 1000) * 1_000_000)


def test_a_spatem_contains_the_minute_of_the_year_and_the_year_is_that_of_the_receipt() -> None:
    state = {"id": {"id": 7}, "revision": 0, "status": (0, 16), "states": []}
    state["states"] = [{"signalGroup": 1, "state-time-speed": [{"eventState": "stop-And-Remain"}]}]
    late = {**state, "moy": 525_599, "timeStamp": 59_500}  # the last minute of 2025
    raw = encode("spatem", {"spat": {"intersections": [late]}})
    assert EtsiDecoder("etsi/spatem").stamp_near(raw, NOW + SECOND) == NOW - SECOND // 2
    raw = encode("spatem", {"spat": {"intersections": [state]}})
    assert EtsiDecoder("etsi/spatem").stamp_near(raw, NOW) is None
    light = EtsiDecoder("etsi/spatem").decode(raw)["spat"]["intersections"][0]["states"][0]
    assert light["state_time_speed"] == [{"eventState": "stop-And-Remain"}]


def test_a_regional_extension_is_read_where_its_definition_is_known() -> None:
    reference = {"lat": 507773210, "long": 61234567}
    regional = [{"regionId": 3, "regExtValue": ("Position3D-addGrpC", {"altitude": ALTITUDE})}]
    intersection = {"id": {"id": 7}, "revision": 0, "refPoint": {**reference, "regional": regional}, "laneSet": [LANE]}
    raw = encode("mapem", {"map": {"msgIssueRevision": 0, "intersections": [intersection]}})
    place = EtsiDecoder("etsi/mapem").decode(raw)["map"]["intersections"][0]["refPoint"]
    assert (place["lat"], place["long"]) == (50.777321, 6.1234567)
    assert place["regional"] == [
        {"regionId": 3.0, "regExtValue": {"altitude": {"altitudeValue": 12.34, "altitudeConfidence": None}}}
    ]


ALTITUDE = {"altitudeValue": 1234, "altitudeConfidence": "unavailable"}
LANE = {
    "laneID": 1,
    "laneAttributes": {"directionalUse": (2, 2), "sharedWith": (0, 10), "laneType": ("vehicle", (0, 8))},
    "nodeList": ("nodes", [{"delta": ("node-XY1", {"x": 100, "y": -250})}, {"delta": ("node-XY1", {"x": 0, "y": 0})}]),
}


@pytest.mark.parametrize(
    ("expression", "problem"),
    [
        ("msg.cam.generationDeltaTme", "msg.cam has no field generationDeltaTme; did you mean generationDeltaTime"),
        ("msg.header.stationID", "msg.header has no field stationID; did you mean stationId"),
        ("msg.cam.camParameters.specialVehicleContainer.emergency", "did you mean emergencyContainer"),
        ("msg.denm", "msg has no field denm; it has cam, header"),
    ],
)
def test_a_field_that_the_message_does_not_have_is_reported_before_any_has_come(expression: str, problem: str) -> None:
    detector = a_detector(STREAM)
    rule = a_rule(signals=[{"name": "x", "stream": "cam", "value": expression}], when="x == 1")
    with pytest.raises(RuleError, match=problem):
        compile_rule(rule, detector, stream_readers(detector).fields)


STREAM = {"name": "cam", "key": "its/${client:*}/cam", "encoding": "uper", "type": "etsi/cam"}


def test_without_the_extra_the_error_names_the_stream_and_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    for package in BY_NAME["cam"].packaged.values():
        monkeypatch.setitem(sys.modules, f"pycrate_asn1dir.{package[0]}", None)
    packaged_definitions.cache_clear()
    with pytest.raises(
        DetectorError, match=r"spec.streams\[0\].type: .* CAM are not installed: pip install 'wayside\["
    ):
        stream_readers(a_detector(STREAM))


def test_the_packages_of_definitions_are_imported_only_where_a_stream_needs_them() -> None:
    heavy = "[name for name in sys.modules if name.startswith(('pycrate', 'asn1tools'))]"
    code = f"import sys, detector.commands.cli, detector.assembly, detector.live.service; print({heavy})"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
