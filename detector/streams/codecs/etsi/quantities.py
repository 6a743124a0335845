"""Numbers of ITS messages in SI units (angles and positions in degrees), with null for unavailable values.

The meaning of a number depends on the name of its type in the ETSI Common Data Dictionary (TS 102 894-2, releases 1 and
2) and DSRC (ISO/TS 19091, SAE J2735). A type that is not listed here is a plain number: a code, an identifier, a count,
or already in the unit that its definition names.

ITS time is milliseconds of TAI since 2004-01-01T00:00:00Z (TimestampIts); some fields contain only a remainder of it.
All other times here are nanoseconds since the Unix epoch unless a name states otherwise.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction

from detector.engine.samples.sample import DecodeError
from detector.streams.codecs.etsi.asn1 import Integer
from wayside.expressions.numbers import as_double

UNAVAILABLE = frozenset({"unavailable", "outOfRange"})
"""The names of numbers and enumeration values that mean "no value"."""

Plain = Callable[[int], float | int | None]
"""Converts a number as sent to its value in expressions."""


@dataclass(frozen=True, slots=True)
class Unit:
    """The value of one step of a number."""

    symbol: str
    """The unit in expressions, for the documentation."""
    step: Fraction
    null: frozenset[int] = frozenset()
    """Numbers that mean "no value" and have no name in the definition."""


def _units(symbol: str, step: str, *names: str, null: int | None = None) -> dict[str, Unit]:
    unit = Unit(symbol, Fraction(step), frozenset() if null is None else frozenset({null}))
    return dict.fromkeys(names, unit)


UNITS: Mapping[str, Unit] = {
    # Common Data Dictionary
    **_units("deg", "1e-7", "Latitude", "Longitude", "DeltaLatitude", "DeltaLongitude"),
    **_units("deg", "0.1", "HeadingValue", "HeadingConfidence", "WGS84AngleValue", "Wgs84AngleValue"),
    **_units("deg", "0.1", "Wgs84AngleConfidence", "CartesianAngleValue", "AngleConfidence"),
    **_units("deg", "1.5", "SteeringWheelAngleValue", "SteeringWheelAngleConfidence"),
    **_units("deg/s", "0.01", "YawRateValue"),
    **_units("deg/s", "1", "CartesianAngularVelocityComponentValue"),
    **_units("deg/s^2", "1", "CartesianAngularAccelerationComponentValue"),
    **_units("m/s", "0.01", "SpeedValue", "SpeedConfidence", "VelocityComponentValue"),
    **_units("m/s", "5/18", "SpeedLimit"),  # sent in km/h
    **_units("m/s^2", "0.1", "LongitudinalAccelerationValue", "LateralAccelerationValue", "VerticalAccelerationValue"),
    **_units("m/s^2", "0.1", "AccelerationValue", "AccelerationMagnitudeValue", "AccelerationConfidence"),
    **_units("1/m", "1e-4", "CurvatureValue"),
    **_units("m", "0.01", "AltitudeValue", "DeltaAltitude", "SemiAxisLength", "HeightLonCarr", "PosLonCarr"),
    **_units("m", "0.01", "CartesianCoordinate", "CartesianCoordinateSmall", "CartesianCoordinateLarge"),
    **_units("m", "0.01", "CoordinateConfidence", "LaneWidth"),
    **_units("m", "0.1", "VehicleLengthValue", "VehicleWidth", "VehicleHeight2", "WheelBaseVehicle"),
    **_units("m", "0.1", "PosCentMass", "PosFrontAx", "PosPillar", "Radius", "SemiRangeLength"),
    **_units("m", "0.1", "StandardLength12b", "StandardLength9b", "StandardLength1B", "StandardLength2B"),
    **_units("m", "0.1", "LongitudinalLanePositionValue", "LongitudinalLanePositionConfidence"),
    **_units("m", "0.1", "ObjectDimensionValue", "ObjectDimensionConfidence"),
    **_units("m", "0.05", "VehicleHeight"),
    **_units("m", "0.4", "TurningRadius"),
    **_units("kg", "100", "VehicleMass"),
    **_units("Pa", "10", "BarometricPressure"),
    **_units("mm/h", "0.1", "PrecipitationIntensity"),
    **_units("", "0.01", "ConfidenceLevel", "CorrelationCellValue"),
    **_units("", "0.02", "TrajectoryInterceptionProbability", "StabilityLossProbability"),
    **_units("", "0.001", "AirHumidity"),
    **_units("", "0.1", "PedalPositionValue"),
    **_units("s", "0.001", "GenerationDeltaTime", "TransmissionInterval"),
    **_units("s", "0.001", "DeltaTimeMilliSecondPositive", "DeltaTimeMilliSecondSigned"),
    **_units("s", "0.01", "PathDeltaTime"),
    **_units("s", "0.1", "DeltaTimeTenthOfSecond", "ActionDeltaTime"),
    **_units("s", "0.256", "DeltaTimeQuarterSecond", "VruClusterOpTimestamp"),
    **_units("s", "10", "DeltaTimeTenSeconds"),
    # DSRC, in MAPEM and SPATEM
    **_units("deg", "0.0125", "Angle", null=28800),
    **_units("deg", "1.5", "MergeDivergeNodeAngle", null=-180),
    **_units(
        "deg", "1e-7", "OffsetLL-B12", "OffsetLL-B14", "OffsetLL-B16", "OffsetLL-B18", "OffsetLL-B22", "OffsetLL-B24"
    ),
    **_units("m", "0.1", "Elevation", null=-4096),
    **_units("m", "0.01", "Offset-B10", "Offset-B11", "Offset-B12", "Offset-B13", "Offset-B14", "Offset-B16"),
    **_units("m", "0.01", "DrivenLineOffsetSm", "DrivenLineOffsetLg"),
    **_units("m/s", "0.02", "Velocity", null=8191),
    **_units("m/s", "0.1", "SpeedAdvice", null=500),
    **_units("s", "60", "MinuteOfTheYear", null=527040),
    **_units("s", "0.001", "DSecond", null=65535),
    **_units("s", "0.1", "TimeMark", null=36001),
}
"""By the name of the type; numbers of other types are plain."""

TIMESTAMP = "TimestampIts"
"""The type of absolute times, which become seconds since the Unix epoch."""

_OF_OTHER_RELEASES: Mapping[tuple[str, int], Unit] = {
    ("CurvatureValue", 30001): Unit("1/m", Fraction(1, 30000)),
}
"""Types that had another step in another release, by name and upper bound."""


def quantity(kind: Integer) -> Plain:
    """The conversion of numbers of the type to their values in expressions."""
    null = {value for name, value in kind.named.items() if name in UNAVAILABLE}
    if kind.name == TIMESTAMP:
        return _time
    unit = _OF_OTHER_RELEASES.get((kind.name, kind.high or 0)) or UNITS.get(kind.name)
    if unit is None:
        return as_double if not null else lambda value: None if value in null else as_double(value)
    null |= unit.null
    up, down = float(unit.step.numerator), float(unit.step.denominator)
    # One multiplication and one division of exact numbers: 4711 steps of 0.01 are 47.11, not 47.110000000000003.
    return lambda value: None if value in null else value * up / down


def _time(milliseconds: int) -> float:
    """Seconds since the Unix epoch."""
    time = unix_ns(milliseconds)
    if time >= 1 << 63:
        raise DecodeError(f"the time {milliseconds} ms is beyond the year 2262")
    return time / 10**9


_SECOND = 10**9
_MILLISECOND = 10**6

_UTC = datetime.UTC


def _seconds(year: int, month: int, day: int) -> int:
    return int(datetime.datetime(year, month, day, tzinfo=_UTC).timestamp())


EPOCH = _seconds(2004, 1, 1)
"""The beginning of ITS time, in seconds since the Unix epoch."""

_LEAPS = tuple(
    _seconds(*day) for day in ((2006, 1, 1), (2009, 1, 1), (2012, 7, 1), (2015, 7, 1), (2017, 1, 1))
)  # fmt: skip
"""The days that began after a leap second since then (IERS Bulletin C); there has been none since 2017."""

WRAP = 65536
"""generationDeltaTime is ITS time in milliseconds modulo this."""


def unix_ns(milliseconds: int) -> int:
    """The Unix time of an ITS time, in nanoseconds since the epoch."""
    seconds = milliseconds // 1000
    leaps = sum(seconds >= day - EPOCH + index + 1 for index, day in enumerate(_LEAPS))
    return (EPOCH - leaps) * _SECOND + milliseconds * _MILLISECOND


def its_ms(unix: int) -> int:
    """The ITS time, in milliseconds, of a Unix time in nanoseconds; negative before 2004."""
    leaps = sum(unix >= day * _SECOND for day in _LEAPS)
    return (unix - (EPOCH - leaps) * _SECOND) // _MILLISECOND


def nearest_time(remainder: int, near: int) -> int:
    """The Unix time nearest to `near` whose ITS time leaves the remainder modulo 65 536 ms."""
    reference = its_ms(near)
    ahead = (remainder - reference) % WRAP
    return unix_ns(reference + (ahead if ahead <= WRAP // 2 else ahead - WRAP))


def in_year(minute: int, milliseconds: int, near: int) -> int:
    """The Unix time nearest to `near` that is this far into this minute of some year (UTC)."""
    year = datetime.datetime.fromtimestamp(near / _SECOND, _UTC).year
    candidates = [
        (_seconds(each, 1, 1) + minute * 60) * _SECOND + milliseconds * _MILLISECOND
        for each in range(max(year - 1, 1970), year + 2)
    ]
    return min(candidates, key=lambda time: abs(time - near))
