"""ITS messages for tests, encoded by pycrate: those that one writes down, and random ones of any type."""

from __future__ import annotations

import copy
import importlib
import random
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

from detector.streams.codecs.etsi.quantities import UNITS

PDUS = {
    "cam": ("ITS_CAM_2", "CAM_PDU_Descriptions", "CAM"),
    "cam of release 1.3": ("ITS_r1318", "CAM_PDU_Descriptions", "CAM"),
    "denm": ("ITS_DENM_3", "DENM_PDU_Descriptions", "DENM"),
    "spatem": ("ITS_IS", "SPATEM_PDU_Descriptions", "SPATEM"),
    "mapem": ("ITS_IS", "MAPEM_PDU_Descriptions", "MAPEM"),
    "vam": ("ITS_VAM_3", "VAM_PDU_Descriptions", "VAM"),
}
"""pycrate's definitions, by a name for the test."""

NUMBERS = {"denm": 1, "cam": 2, "spatem": 4, "mapem": 5, "vam": 16}

STATION = 4711


def pdu(name: str) -> Any:
    package, module, kind = PDUS[name]
    return getattr(getattr(importlib.import_module(f"pycrate_asn1dir.{package}"), module), kind)


def encode(name: str, value: Mapping[str, Any]) -> bytes:
    """The message with a header put before it."""
    kind = pdu(name)
    keys = [key.lower() for key in kind._cont["header"]._cont]
    assert keys == ["protocolversion", "messageid", "stationid"]
    kind.set_val({"header": header(kind, name), **value})
    return bytes(kind.to_uper())


def header(kind: Any, name: str) -> dict[str, int]:
    numbers = (1 if "1.3" in name else 2, NUMBERS[name.split(maxsplit=1)[0]], STATION)
    return dict(zip(kind._cont["header"]._cont, numbers, strict=True))


_CAM = {
    "generationDeltaTime": 12345,
    "camParameters": {
        "basicContainer": {
            "stationType": 10,
            "referencePosition": {
                "latitude": 507773210,
                "longitude": 61234567,
                "positionConfidenceEllipse": {
                    "semiMajorConfidence": 100,
                    "semiMinorConfidence": 4095,
                    "semiMajorOrientation": 900,
                },
                "altitude": {"altitudeValue": 800001, "altitudeConfidence": "unavailable"},
            },
        },
        "highFrequencyContainer": (
            "basicVehicleContainerHighFrequency",
            {
                "heading": {"headingValue": 1234, "headingConfidence": 10},
                "speed": {"speedValue": 1389, "speedConfidence": 127},
                "driveDirection": "forward",
                "vehicleLength": {
                    "vehicleLengthValue": 42,
                    "vehicleLengthConfidenceIndication": "noTrailerPresent",
                },
                "vehicleWidth": 18,
                "longitudinalAcceleration": {
                    "longitudinalAccelerationValue": -12,
                    "longitudinalAccelerationConfidence": 102,
                },
                "curvature": {"curvatureValue": 100, "curvatureConfidence": "unavailable"},
                "curvatureCalculationMode": "yawRateUsed",
                "yawRate": {"yawRateValue": -150, "yawRateConfidence": "degSec-000-01"},
                "accelerationControl": (0b1000001, 7),
            },
        ),
    },
}


def a_cam(
    *, station: int = STATION, milliseconds: int = 12345, lightbar: bool | None = None, latitude: float = 50.777321
) -> bytes:
    """A CAM of a vehicle; `lightbar` None is one without emergency container."""
    cam = copy.deepcopy(_CAM)
    cam["generationDeltaTime"] = milliseconds % 65536
    parameters: dict[str, Any] = cam["camParameters"]  # type: ignore[assignment]
    parameters["basicContainer"]["referencePosition"]["latitude"] = round(latitude * 1e7)
    if lightbar is not None:
        parameters["specialVehicleContainer"] = ("emergencyContainer", {"lightBarSirenInUse": (2 * lightbar, 2)})
    raw = encode("cam", {"cam": cam})
    return raw[:2] + station.to_bytes(4, "big") + raw[6:]


def random_message(name: str, chance: random.Random) -> tuple[bytes, dict[str, Any]]:
    """An encoded message and the expected value."""
    kind = pdu(name)
    value, expected = random_value(kind, chance)
    value["header"] = header(kind, name)
    expected["header"] = dict(
        zip(("protocolVersion", "messageId", "stationId"), map(float, value["header"].values()), strict=True)
    )
    kind.set_val(value)
    return bytes(kind.to_uper()), expected


def random_value(kind: Any, chance: random.Random) -> tuple[Any, Any]:
    """A value of a pycrate type as pycrate takes it, and as expressions must see it."""
    match kind.TYPE:
        case "BOOLEAN":
            return (flag := chance.random() < 0.5), flag
        case "NULL":
            return 0, True
        case "INTEGER":
            low, high = kind._const_val.lb, kind._const_val.ub
            value = chance.choice((low, high, chance.randint(low, high)))
            return value, expected_number(kind, value)
        case "ENUMERATED":
            name = chance.choice(kind._root)
            return name, None if name in ("unavailable", "outOfRange") else name
        case "BIT STRING":
            size = _size(kind, chance)
            bits = [chance.random() < 0.5 for _ in range(size)]
            number = sum(bit << (size - 1 - at) for at, bit in enumerate(bits))
            names = {at: name for name, at in dict(kind._cont or {}).items()}
            return (number, size), [names.get(at, str(at)) for at, bit in enumerate(bits) if bit] if names else bits
        case "OCTET STRING":
            octets = chance.randbytes(_size(kind, chance))
            return octets, octets
        case "SEQUENCE OF":
            items = [random_value(kind._cont, chance) for _ in range(_size(kind, chance))]
            return [item for item, _ in items], [item for _, item in items]
        case "SEQUENCE":
            return _random_sequence(kind, chance)
        case "CHOICE":
            name = chance.choice([name for name in kind._root if name != "regional"])
            value, expected = random_value(kind._cont[name], chance)
            return (name, value), {name.replace("-", "_"): expected}
        case _:
            characters = "0123456789 " if kind.TYPE == "NumericString" else "aZ09 -~"
            length = _size(kind, chance)
            text = "".join(chance.choice(characters) for _ in range(length))
            return text, text


def _random_sequence(kind: Any, chance: random.Random) -> tuple[dict[str, Any], dict[str, Any]]:
    value, expected = {}, {}
    for name in kind._root:
        part = kind._cont[name]
        if name in ("regional", "preemptPriorityData"):
            continue  # they are or hold open types, whose content hangs on another field: a test of its own has it
        if (part._opt or part._def is not None) and chance.random() < 0.5:
            if part._def is not None:
                expected[name.replace("-", "_")] = expected_number(part, part._def)
            continue
        value[name], expected[name.replace("-", "_")] = random_value(part, chance)
    return value, expected


def _size(kind: Any, chance: random.Random) -> int:
    bounds = kind._const_sz
    if bounds is None:
        return chance.randint(0, 200)
    return chance.randint(bounds.lb or 0, min(bounds.ub, (bounds.lb or 0) + 3))


def expected_number(kind: Any, value: int) -> float | None:
    """The number in its unit, by exact arithmetic."""
    names = {number for name, number in dict(kind._cont or {}).items() if name in ("unavailable", "outOfRange")}
    name = kind._typeref.called[1] if kind._typeref is not None else ""
    if value in names:
        return None
    if name == "TimestampIts":
        return time_of(value)
    unit = UNITS.get(name)
    if unit is None:
        return float(value)
    step = Fraction(1, 30000) if (name, kind._const_val.ub) == ("CurvatureValue", 30001) else unit.step
    return None if value in unit.null else float(value * step)


def time_of(milliseconds: int) -> float:
    """The Unix time of an ITS time, by counting leap seconds one by one."""
    leaps = (63072000, 157766401, 268099202, 362793603, 410227204)  # seconds of ITS time right after each
    seconds = Fraction(milliseconds, 1000)
    return float(1072915200 + seconds - sum(seconds > leap for leap in leaps))
