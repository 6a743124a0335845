"""Two cars and the weather: rain, fog, both; and a windscreen that is washed.

The truth is how hard it rains, how far one sees and whether the wipers go, over time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from examples.running.drawing import Chart
from examples.running.scenario import SECOND, START_NS, Episode, Message, Moment, Scenario, as_json

SEED = 6
DURATION_S = 110
PERIOD_NS = SECOND // 2
TIMES = [each / 20 for each in range(20, DURATION_S * 20)]
"""The times at which the truth is evaluated, in seconds."""
NOISE_S = 0.6
"""By how much earlier or later means of noisy measurements cross a threshold than the true ones."""
LOOKS_S = 1.0
"""The rules look every half second, and so do the sensors."""

Curve = Sequence[tuple[float, float]]
"""Seconds and values, with straight lines between."""


@dataclass(frozen=True, slots=True)
class Weather:
    """Rain (mm/h), visibility (m), and the times at which the wipers run."""

    rain: Curve
    visibility: Curve
    wipers: Sequence[tuple[float, float]]

    def rain_at(self, t: float) -> float:
        """In mm/h."""
        return _value(self.rain, t)

    def visibility_at(self, t: float) -> float:
        """In metres."""
        return _value(self.visibility, t)

    def wipers_at(self, t: float) -> int:
        """1 while they go."""
        return int(any(start <= t < end for start, end in self.wipers))


def _value(curve: Curve, t: float) -> float:
    return float(np.interp(t, [at for at, _ in curve], [value for _, value in curve]))


TRUTH = {
    # Drives into rain, then into fog while it still rains, and out of both.
    "car-1": Weather(
        [(10, 0), (14, 8), (60, 8), (66, 0)], [(40, 2000), (44, 60), (80, 60), (86, 2000)], [(11, 66)]
    ),
    # Washes its windscreen: the rain sensor is wet for four seconds.
    "car-2": Weather([(30, 0), (30.5, 10), (33.5, 10), (34, 0)], [(0, 2000)], [(30, 36)]),
}  # fmt: skip


def scenario(seed: int = SEED) -> Scenario:
    """Not quite two minutes."""
    due = episodes()
    return Scenario(
        title="Weather-aware perception",
        seed=seed,
        messages=lambda: messages(seed),
        episodes=due,
        actions={"weather-perception/perception": 2, "rain/rain": 1, "fog/fog": 1},
        moments=[moment(at, due) for at in (8.0, 32.0, 54.0, 76.0, 104.0)],
        picture=lambda: picture(due),
    )


def messages(seed: int) -> Iterator[Message]:
    """The measurements of each car's sensors, twice a second."""
    for number, (car, weather) in enumerate(TRUTH.items()):
        rng = np.random.default_rng([seed, number])
        for index in range(DURATION_S * SECOND // PERIOD_NS):
            after = index * PERIOD_NS + (number + 1) * SECOND // 50
            t = after / SECOND
            content = {
                "stamp": (START_NS + after) / SECOND,
                "rain": max(0.0, weather.rain_at(t) * (1 + 0.05 * rng.standard_normal())),
                "visibility": weather.visibility_at(t) * (1 + 0.02 * rng.standard_normal()),
                "wipers": weather.wipers_at(t),
            }
            yield Message(after, f"vehicles/{car}/weather", as_json(content))


def episodes() -> list[Episode]:
    """From the truth: ten seconds of rain with the wipers on, five of fog."""
    found = [Episode("weather-perception", car, 0.0) for car in TRUTH]
    for car, weather in TRUTH.items():
        rained, wiped = _mean(weather.rain_at, 10.0), _mean(weather.wipers_at, 10.0)
        seen = _mean(weather.visibility_at, 5.0)
        found += _spans("rain", car, [t for t in TIMES if rained(t) > 2 and wiped(t) > 0.999],
                        [t for t in TIMES if rained(t) < 0.5])  # fmt: skip
        found += _spans("fog", car, [t for t in TIMES if seen(t) < 100], [t for t in TIMES if seen(t) > 200])
    return found


def _mean(value: Callable[[float], float], over_s: float) -> Callable[[float], float]:
    def mean(t: float) -> float:
        return float(np.mean([value(each) for each in np.arange(max(0.0, t - over_s), t, 0.25)]))

    return mean


def _spans(rule: str, car: str, begins: Sequence[float], ends: Sequence[float]) -> Iterator[Episode]:
    """Each from when it can begin until the first time after that at which it is over."""
    over = 0.0
    for start in begins:
        if start >= over:
            over = next(t for t in ends if t > start)
            yield Episode(rule, car, start - NOISE_S, over - NOISE_S, 2 * NOISE_S + LOOKS_S)


def moment(at_s: float, due: Sequence[Episode]) -> Moment:
    """The expected applications at a time that is more than two seconds from any change."""
    runs: dict[str, dict[str, object]] = {}
    for car in TRUTH:
        bad = {each.rule for each in due if each.subject == car and each.start_s <= at_s < (each.end_s or DURATION_S)}
        runs[f"weather-perception/{car}"] = {
            "lidarFilter": "spray" if "rain" in bad else "none",
            "trust": {"camera": 0.3 if "fog" in bad else 1, "radar": 1},
            "maxRange": 60 if "fog" in bad else 90 if "rain" in bad else 120,
        }
    return Moment(at_s, runs)


def picture(due: Sequence[Episode]) -> str:
    """The weather, and the configuration of perception."""
    chart = Chart(DURATION_S)
    times = [each / 2 for each in range(DURATION_S * 2)]
    rain = [(car, [(t, weather.rain_at(t)) for t in times]) for car, weather in TRUTH.items()]
    chart.curves("rain at the sensor, mm/h", rain, 0, 12)
    visibility = [(car, [(t, weather.visibility_at(t)) for t in times]) for car, weather in TRUTH.items()]
    chart.curves("metres that one sees", visibility, 0, 500, ("fog", 100))
    rows = [
        (f"{rule}, {car}", [(each.start_s + NOISE_S, (each.end_s or DURATION_S) + NOISE_S, "") for each in due
                            if (each.rule, each.subject) == (rule, car)])
        for rule in ("rain", "fog") for car in TRUTH
    ]  # fmt: skip
    chart.bars("perception is configured for", rows, "#1b6ca8")
    return chart.svg()
