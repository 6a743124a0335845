"""Motion: the time to collision and the closest approach of two bodies at constant velocity."""

from __future__ import annotations

import math

from wayside.expressions.functions.declaring import ResultType, function


def time_to_collision(gap: float, closing_speed: float) -> float:
    """The seconds until a gap (m) is closed at a speed (m/s): 0 without a gap, infinite if it does not close."""
    if gap <= 0:
        return 0.0
    return gap / closing_speed if closing_speed > 0 else math.inf


def time_to_contact(dx: float, dy: float, vx: float, vy: float, radius: float) -> float:
    """The seconds until two bodies on straight paths are `radius` metres apart; infinite if they never are.

    dx, dy (m) and vx, vy (m/s) are the position and velocity of one body relative to the other. The result is the
    first root of |d + v t| = radius, in a form without cancellation.
    """
    if radius < 0:
        raise ValueError(f"radius must be 0 or more; got {radius:g}")
    if not all(map(math.isfinite, (dx, dy, vx, vy, radius))):
        raise ValueError("the arguments of timeToCollision must be finite")
    apart = math.hypot(dx, dy)
    if apart <= radius:
        return 0.0
    speed = math.hypot(vx, vy)
    if speed == 0:
        return math.inf
    ux, uy = _direction(vx, vy)
    ahead = -(dx * ux + dy * uy)  # metres to go to the nearest point
    aside = abs(dx * uy - dy * ux)  # metres apart, there
    if ahead <= 0 or aside > radius:
        return math.inf
    reach = math.sqrt((radius - aside) * (radius + aside))
    return max(0.0, (apart - radius) * ((apart + radius) / (ahead + reach)) / speed)


def closing(dx: float, dy: float, vx: float, vy: float) -> float:
    """The speed at which two bodies approach each other now, in m/s. At the same position, they can only separate."""
    apart = math.hypot(dx, dy)
    return -(dx / apart * vx + dy / apart * vy) if apart > 0 else -math.hypot(vx, vy)


def closest_approach(dx: float, dy: float, vx: float, vy: float) -> float:
    """The smallest distance that two bodies on straight paths will have from now on, in metres."""
    if vx == vy == 0:
        return math.hypot(dx, dy)
    ux, uy = _direction(vx, vy)
    return math.hypot(dx, dy) if dx * ux + dy * uy >= 0 else abs(dx * uy - dy * ux)


def _direction(vx: float, vy: float) -> tuple[float, float]:
    """The unit vector of the velocity. The velocity is scaled first, since the length of a tiny one is imprecise."""
    largest = max(abs(vx), abs(vy))
    ux, uy = vx / largest, vy / largest
    length = math.hypot(ux, uy)
    return ux / length, uy / length


FUNCTIONS = (
    function(
        "timeToCollision",
        ResultType.NUMBER,
        "seconds until the gap (m) is closed at closingSpeed (m/s), or until two bodies on straight paths are "
        "radius (m) apart, where dx, dy (m) and vx, vy (m/s) are the relative position and velocity; infinite if "
        "that never happens",
        (time_to_collision, "gap closingSpeed"),
        (time_to_contact, "dx dy vx vy radius"),
    ),
    function(
        "closing",
        ResultType.NUMBER,
        "how fast two bodies approach each other, m/s; negative if they separate; arguments as for timeToCollision",
        (closing, "dx dy vx vy"),
    ),
    function(
        "closestApproach",
        ResultType.NUMBER,
        "the smallest distance that two bodies on straight paths will have, metres; arguments as for timeToCollision",
        (closest_approach, "dx dy vx vy"),
    ),
)
