"""CAM and DENM of vehicles, encoded as ITS stations send them (UPER), by pycrate."""

from __future__ import annotations

from typing import Any

from pycrate_asn1dir.ITS_CAM_2 import CAM_PDU_Descriptions
from pycrate_asn1dir.ITS_DENM_3 import DENM_PDU_Descriptions

_CAM, _DENM = CAM_PDU_Descriptions.CAM, DENM_PDU_Descriptions.DENM
_EPOCH_S = 1_072_915_200 - 5
"""ITS time begins with 2004; since then there were five leap seconds, which it counts."""
_APPROACHING = 95
"""The cause code of an emergency vehicle that approaches."""

Place = tuple[float, float]
"""Degrees north and east."""


def cam(station: int, kind: int, time_s: float, place: Place, speed: float, light_bar: bool | None = None) -> bytes:
    """A vehicle's cooperative awareness message.

    Args:
        station: its id.
        kind: its station type; 5 is a passenger car, 10 a special vehicle.
        time_s: Unix time.
        place: where it is.
        speed: m/s.
        light_bar: whether the light bar is on; None: it has none.
    """
    parameters: dict[str, Any] = {
        "basicContainer": {"stationType": kind, "referencePosition": _position(place)},
        "highFrequencyContainer": ("basicVehicleContainerHighFrequency", {
            "heading": {"headingValue": 3601, "headingConfidence": 127},
            "speed": {"speedValue": round(speed * 100), "speedConfidence": 127},
            "driveDirection": "forward",
            "vehicleLength": {"vehicleLengthValue": 45, "vehicleLengthConfidenceIndication": "noTrailerPresent"},
            "vehicleWidth": 18,
            "longitudinalAcceleration": {"longitudinalAccelerationValue": 161,
                                         "longitudinalAccelerationConfidence": 102},
            "curvature": {"curvatureValue": 1023, "curvatureConfidence": "unavailable"},
            "curvatureCalculationMode": "unavailable",
            "yawRate": {"yawRateValue": 32767, "yawRateConfidence": "unavailable"},
        }),
    }  # fmt: skip
    if light_bar is not None:
        parameters["specialVehicleContainer"] = ("emergencyContainer", {"lightBarSirenInUse": (3 * light_bar, 2)})
    header = _header(_CAM, 2, station)
    content = {"generationDeltaTime": its_milliseconds(time_s) % 65536, "camParameters": parameters}
    _CAM.set_val({"header": header, "cam": content})
    return bytes(_CAM.to_uper())


def denm(station: int, time_s: float, place: Place, *, cancels: bool = False) -> bytes:
    """An emergency vehicle's warning that it approaches, or that it no longer does."""
    now = its_milliseconds(time_s)
    management: dict[str, Any] = {
        "actionID": {"originatingStationID": station, "sequenceNumber": 1},
        "detectionTime": now, "referenceTime": now, "eventPosition": _position(place), "validityDuration": 10,
        "stationType": 10,
    }  # fmt: skip
    if cancels:
        management["termination"] = "isCancellation"
    situation = {"informationQuality": 3, "eventType": {"causeCode": _APPROACHING, "subCauseCode": 1}}
    _DENM.set_val({"header": _header(_DENM, 1, station), "denm": {"management": management, "situation": situation}})
    return bytes(_DENM.to_uper())


def its_milliseconds(time_s: float) -> int:
    """ITS time of a Unix time."""
    return round((time_s - _EPOCH_S) * 1000)


def _header(kind: Any, number: int, station: int) -> dict[str, int]:
    """Its three components; the definitions write their names differently."""
    return dict(zip(kind._cont["header"]._cont, (2, number, station), strict=True))


def _position(place: Place) -> dict[str, Any]:
    return {
        "latitude": round(place[0] * 1e7), "longitude": round(place[1] * 1e7),
        "positionConfidenceEllipse": {"semiMajorConfidence": 100, "semiMinorConfidence": 100,
                                      "semiMajorOrientation": 0},
        "altitude": {"altitudeValue": 800001, "altitudeConfidence": "unavailable"},
    }  # fmt: skip
