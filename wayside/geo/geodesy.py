"""Distances on the Earth: the ellipsoid WGS 84, angles in degrees, lengths in metres."""

from __future__ import annotations

import math

SEMI_MAJOR = 6_378_137.0
"""The equator's radius, in metres."""

FLATTENING = 1 / 298.257223563

_SEMI_MINOR = SEMI_MAJOR * (1 - FLATTENING)
_ECCENTRICITY_2 = FLATTENING * (2 - FLATTENING)
_STEPS = 100
_CONVERGED = 1e-13
"""Radians: less than a micrometre."""


def cartesian(latitude: float, longitude: float) -> tuple[float, float, float]:
    """A point on the ellipsoid in metres from the Earth's centre (ECEF).

    The straight line between two such points is never longer than the distance along the surface, and neither the
    antimeridian nor the poles are special cases. So neighbours within a distance are searched in these coordinates.
    """
    phi, lam = math.radians(latitude), math.radians(longitude)
    normal = SEMI_MAJOR / math.sqrt(1 - _ECCENTRICITY_2 * math.sin(phi) ** 2)
    return (
        normal * math.cos(phi) * math.cos(lam),
        normal * math.cos(phi) * math.sin(lam),
        normal * (1 - _ECCENTRICITY_2) * math.sin(phi),
    )


def degrees(latitude: float) -> tuple[float, float]:
    """The length of a degree of latitude and of one of longitude at a latitude, in metres."""
    sine = math.sin(math.radians(latitude))
    rest = 1 - _ECCENTRICITY_2 * sine * sine
    meridian = SEMI_MAJOR * (1 - _ECCENTRICITY_2) / (rest * math.sqrt(rest))
    normal = SEMI_MAJOR / math.sqrt(rest)
    return math.radians(meridian), math.radians(normal * math.cos(math.radians(latitude)))


def surface_distance(latitude_1: float, longitude_1: float, latitude_2: float, longitude_2: float) -> float:
    """The distance along the surface between two positions, in metres; heights are ignored.

    Vincenty's inverse formula ("Direct and inverse solutions of geodesics on the ellipsoid", Survey Review 176, 1975),
    accurate to less than a millimetre. For nearly antipodal positions it does not converge; then the result is the
    distance on a sphere of the mean radius, with an error of up to 0.6 %.
    """
    reduced_1, reduced_2 = _reduced(latitude_1), _reduced(latitude_2)
    sin_1, cos_1, sin_2, cos_2 = math.sin(reduced_1), math.cos(reduced_1), math.sin(reduced_2), math.cos(reduced_2)
    # The shorter way around the Earth, without the rounding error of a difference of 360 degrees.
    difference = math.radians(math.remainder(longitude_2 - longitude_1, 360.0))
    lam = difference
    for _ in range(_STEPS):
        sin_lam, cos_lam = math.sin(lam), math.cos(lam)
        sin_sigma = math.hypot(cos_2 * sin_lam, cos_1 * sin_2 - sin_1 * cos_2 * cos_lam)
        if sin_sigma == 0:
            return 0.0
        cos_sigma = sin_1 * sin_2 + cos_1 * cos_2 * cos_lam
        sigma = math.atan2(sin_sigma, cos_sigma)
        sin_alpha = cos_1 * cos_2 * sin_lam / sin_sigma
        cos_alpha_2 = 1 - sin_alpha**2
        cos_middle = cos_sigma - 2 * sin_1 * sin_2 / cos_alpha_2 if cos_alpha_2 > 0 else 0.0  # along the equator
        c = FLATTENING / 16 * cos_alpha_2 * (4 + FLATTENING * (4 - 3 * cos_alpha_2))
        before, lam = (
            lam,
            difference
            + (1 - c)
            * FLATTENING
            * sin_alpha
            * (sigma + c * sin_sigma * (cos_middle + c * cos_sigma * (2 * cos_middle**2 - 1))),
        )
        if abs(lam - before) < _CONVERGED:
            return _length(sigma, sin_sigma, cos_sigma, cos_alpha_2, cos_middle)
        if abs(lam) > math.pi:
            break
    return _on_sphere(latitude_1, latitude_2, difference)


def _reduced(latitude: float) -> float:
    """The latitude on the auxiliary sphere, in radians."""
    phi = math.radians(latitude)
    return math.atan2((1 - FLATTENING) * math.sin(phi), math.cos(phi))


def _length(sigma: float, sin_sigma: float, cos_sigma: float, cos_alpha_2: float, cos_middle: float) -> float:
    u2 = cos_alpha_2 * (SEMI_MAJOR**2 - _SEMI_MINOR**2) / _SEMI_MINOR**2
    a = 1 + u2 / 16384 * (4096 + u2 * (-768 + u2 * (320 - 175 * u2)))
    b = u2 / 1024 * (256 + u2 * (-128 + u2 * (74 - 47 * u2)))
    correction = (
        b
        * sin_sigma
        * (
            cos_middle
            + b
            / 4
            * (
                cos_sigma * (2 * cos_middle**2 - 1)
                - b / 6 * cos_middle * (4 * sin_sigma**2 - 3) * (4 * cos_middle**2 - 3)
            )
        )
    )
    return _SEMI_MINOR * a * (sigma - correction)


def _on_sphere(latitude_1: float, latitude_2: float, difference: float) -> float:
    phi_1, phi_2 = math.radians(latitude_1), math.radians(latitude_2)
    half = math.sin((phi_2 - phi_1) / 2) ** 2 + math.cos(phi_1) * math.cos(phi_2) * math.sin(difference / 2) ** 2
    return 2 * (2 * SEMI_MAJOR + _SEMI_MINOR) / 3 * math.asin(math.sqrt(min(1.0, half)))
