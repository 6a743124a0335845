"""Four electric buses and their batteries' reports; one is worn out, one wears out, one only has wrong reports.

The truth is each battery's health over time. The reports of its management system are noisy, and sometimes wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from examples.running.drawing import Chart
from examples.running.playing import Played, seconds
from examples.running.recording import missing_messages, read_recording, within
from examples.running.ros import header, make, ros_message
from examples.running.scenario import SECOND, Episode, Message, Scenario, as_json

SEED = 20
DURATION_S = 240
DESIGN_AH = 280.0
CELLS = 12
THRESHOLD, RECOVERED = 0.80, 0.82
WINDOW_S, ENOUGH, LASTING_S = 60, 30, 10
REPORT_S = 30
NOISE_S = 1.5
"""By how much earlier or later a mean of noisy reports crosses a threshold than the true mean."""
NEW_BATTERY_S, WEAR_S = 150.0, 90.0
BATTERY = "sensor_msgs/msg/BatteryState"


def _wearing(t: float) -> float:
    """A block of cells fails in a minute and a half; after that the rest holds."""
    return 0.843 if t < WEAR_S else 0.762 + 0.081 * math.exp(-(t - WEAR_S) / 6.0)


TRUTH: dict[str, Callable[[float], float]] = {
    "bus-1": lambda t: 0.931,
    "bus-2": _wearing,
    "bus-3": lambda t: 0.826,
    "bus-4": lambda t: 0.715 if t < NEW_BATTERY_S else 0.972,
}
"""State of health over time: what the battery holds of what it held when new."""


def scenario(seed: int = SEED) -> Scenario:
    """The buses' four minutes."""
    due = episodes()
    return Scenario(
        title="Battery health below a threshold",
        seed=seed,
        messages=lambda: messages(seed),
        episodes=due,
        actions={"battery-health/operator": 2, "battery-report/data": 2},
        picture=lambda: picture(seed, due),
        check=lambda played: check(played, list(messages(seed))),
    )


def messages(seed: int) -> Iterator[Message]:
    """Each bus reports its battery once a second, and itself every ten seconds."""
    for number, (bus, health) in enumerate(TRUTH.items()):
        rng = np.random.default_rng([seed, number])
        phase = round((0.1 + 0.2 * number) * SECOND)
        voltages = 3.62 + 0.004 * rng.standard_normal(CELLS)
        for second in range(DURATION_S):
            after, t = phase + second * SECOND, second + phase / SECOND
            capacity = _reported_capacity(bus, t, health(t) * (1 + 0.004 * rng.standard_normal()))
            current = -60.0 + 25.0 * math.sin(t / 9.0) + rng.standard_normal()
            sag = 0.06 * (1.0 - health(t))
            cells = voltages + 0.0004 * current
            cells[3] -= 4 * sag  # the weak one
            state = make(
                BATTERY, header=header(after, f"{bus}/battery"), voltage=float(cells.sum()),
                temperature=27.0 + 14.0 * (1 - health(t)) + 0.1 * rng.standard_normal(), current=current,
                charge=0.6 * DESIGN_AH * health(t), capacity=capacity, design_capacity=DESIGN_AH, percentage=0.6,
                power_supply_status=2, power_supply_health=1, power_supply_technology=2, present=True,
                cell_voltage=cells.astype(np.float32), cell_temperature=np.full(CELLS, 27.0, np.float32),
                location="roof", serial_number=f"{bus}-pack",
            )  # fmt: skip
            yield ros_message(after, f"vehicles/{bus}/battery", BATTERY, state)
            if second % 10 == 0:
                content = {"odometerKm": 40_000.0 * (number + 1) + 0.011 * t, "fullCycles": 700 * (number + 1)}
                yield Message(after + SECOND // 20, f"vehicles/{bus}/service", as_json(content))


def _reported_capacity(bus: str, t: float, health: float) -> float:
    """The capacity in Ah that the battery management system reports."""
    if bus == "bus-3" and 60 <= t < 63:
        return 0.0  # it restarts
    if bus == "bus-3" and 63 <= t < 66:
        return math.nan
    if bus == "bus-3" and 120 <= t < 128:
        return 0.70 * DESIGN_AH  # it restarts its estimate, which is wrong at first
    return DESIGN_AH * health


def episodes() -> list[Episode]:
    """From the truth alone: when the mean of a minute has been below the threshold for ten seconds."""
    found: list[tuple[str, float, float | None]] = []
    for bus, health in TRUTH.items():
        begins = None
        start = None
        for t in np.arange(ENOUGH, DURATION_S, 0.1):
            mean = float(np.mean([health(each) for each in np.arange(max(0.0, t - WINDOW_S), t, 0.5)]))
            if start is None:
                begins = (t if begins is None else begins) if mean < THRESHOLD else None
                if begins is not None and t - begins >= LASTING_S:
                    start = float(t)
            elif mean > RECOVERED:
                found.append((bus, start, float(t)))
                break
        else:
            if start is not None:
                found.append((bus, start, None))
    alarms = [
        Episode("battery-health", bus, start - NOISE_S, None if end is None else end - NOISE_S, 2 * NOISE_S)
        for bus, start, end in found
    ]
    reports = [
        Episode("battery-report", bus, start - NOISE_S, start - NOISE_S + REPORT_S, 2 * NOISE_S)
        for bus, start, _ in found
    ]
    return alarms + reports


def check(played: Played, sent: list[Message]) -> Iterator[str]:
    """The operator received the right health, and each recording contains a minute and a half of that bus."""
    reported = {each.content["subject"]: each.content["data"]["notification"] for each in played.notices}
    for event in played.events:
        if event.episode.rule == "battery-health" and event.started:
            bus, at = event.episode.subject, seconds(event.time)
            truth = np.mean([TRUTH[bus](t) for t in np.arange(max(0.0, at - WINDOW_S), at, 0.5)])
            logged = float(reported[bus]["labels"]["health"]) if bus in reported else math.nan
            if not abs(logged - truth) < 0.005:
                yield f"the operator was notified that the health of {bus} is {logged}; it is {truth:.3f}"
    ends = [event for event in played.events if event.episode.rule == "battery-report" and not event.started]
    spans = {event.episode.subject: event for event in ends}
    for folder in played.recordings("battery-report"):
        (bus,) = (each for each in spans if f"_{each}_" in folder.name)
        first, last = seconds(spans[bus].episode.onset_time) - 60, seconds(spans[bus].end_time or 0)
        must = within(sent, [bus], first, last)
        yield from missing_messages(must, read_recording(folder), f"the report of {bus}")


def picture(seed: int, due: list[Episode]) -> str:
    """The reported capacity of the batteries, and the times of the notifications."""
    chart = Chart(DURATION_S)
    logged = []
    for number, (bus, health) in enumerate(TRUTH.items()):
        rng = np.random.default_rng([seed, number])
        noise = 0.004 * rng.standard_normal(DURATION_S)
        values = [_reported_capacity(bus, t, health(t) * (1 + noise[t])) / DESIGN_AH for t in range(DURATION_S)]
        logged.append((bus, [(t, value) for t, value in enumerate(values) if not math.isnan(value)]))
    chart.curves("state of health as reported by the batteries", logged, 0.6, 1.0, ("threshold", THRESHOLD))
    for rule in ("battery-health", "battery-report"):
        rows = [
            (each.subject, [(each.start_s + NOISE_S, DURATION_S if each.end_s is None else each.end_s + NOISE_S, "")])
            for each in due if each.rule == rule
        ]  # fmt: skip
        chart.bars(rule, rows)
    return chart.svg()
