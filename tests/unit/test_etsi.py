"""ETSI ITS messages: against pycrate's encoder, in SI units, with null for what is unavailable."""

from __future__ import annotations

import random

import pytest

from detector.engine.sample import DecodeError
from detector.streams.codecs.etsi import DefinitionError, EtsiDecoder
from detector.streams.codecs.etsi.times import its_ms, nearest, unix_ns
from tests.unit.its_messages import PDUS, a_cam, random_message

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
def test_whatever_pycrate_encodes_is_read_alike(name: str) -> None:
    decoder = EtsiDecoder("etsi/" + name.split(maxsplit=1)[0])
    for seed in range(60):
        raw, expected = random_message(name, random.Random(f"{name}{seed}"))
        assert decoder.decode(raw) == expected, seed


def test_a_stream_without_type_takes_messages_of_all_kinds_and_one_with_type_no_others() -> None:
    denm, _ = random_message("denm", random.Random(1))
    assert "denm" in EtsiDecoder().decode(denm)
    with pytest.raises(DecodeError, match=r"message 1 \(etsi/denm\), the stream is of etsi/cam"):
        EtsiDecoder("etsi/cam").decode(denm)


def test_an_unknown_type_is_refused_with_those_that_are_known() -> None:
    with pytest.raises(DefinitionError, match=r"'etsi/camm': etsi/denm, etsi/cam, .* are known"):
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
    assert nearest(its_ms(sent) % 65536, sent + late * 1_000_000) == sent
    assert EtsiDecoder("etsi/cam").stamp_near(a_cam(milliseconds=its_ms(sent)), sent + late * 1_000_000) == sent
