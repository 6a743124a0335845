"""The vertical acceleration of a vehicle over road surfaces, without gravity, at 50 samples a second."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

RATE_HZ = 50
Samples = NDArray[np.float64]
"""m/s²."""


def asphalt(count: int, rng: np.random.Generator) -> Samples:
    """Number of samples of good road."""
    return rng.normal(0.0, 0.25, count)


def cobbles(count: int, rng: np.random.Generator) -> Samples:
    """The noise of cobblestones."""
    return rng.normal(0.0, rng.uniform(1.0, 1.8), count)


def pothole(rng: np.random.Generator) -> Samples:
    """A wheel falls in, and hits the edge: short down, and shorter and harder up."""
    depth = rng.uniform(0.8, 1.2)
    return depth * np.array([-1.5, -4.0, -5.0, 7.5, 6.0, -2.0, 1.0])


def speed_bump(rng: np.random.Generator) -> Samples:
    """Up and down, slowly, and as hard as a pothole."""
    time = np.linspace(0.0, 2 * np.pi, round(RATE_HZ * rng.uniform(0.4, 0.6)))
    return rng.uniform(6.0, 10.0) * np.sin(time)


def add(road: Samples, shape: Samples, at: int) -> None:
    """Drive over a thing whose first sample is that one."""
    road[at : at + len(shape)] += shape[: len(road) - at]
