"""The rules of docs/evaluation.md, as they stand there."""

from __future__ import annotations

from typing import Any

import yaml

from tests.driving import Drive, a_detector, a_stream, arrival
from tests.guides import guide, yaml_blocks
from wayside.api import Detector, EventRule
from wayside.rules import dependency_problems


def documents(section: str) -> list[dict[str, Any]]:
    """The YAML documents of a section of the page, all blocks together."""
    text = guide("evaluation").split(f"\n## {section}\n")[1].split("\n## ")[0]
    return [document for block in yaml_blocks(text) for document in yaml.safe_load_all(block)]


def detector() -> Detector:
    return a_detector(*(a_stream(name) for name in ("speed", "yaw-rate", "hazard")))


def series(stream: str, values: str) -> list[Any]:
    """A sample a second from 0.5 s on; a digit is its value."""
    return [arrival(0.5 + n, "car", {"v": float(value)}, stream) for n, value in enumerate(values)]


def test_count_sequence_escalation_and_absence() -> None:
    rules = [EventRule.model_validate(each) for each in documents("Rules over rules")]
    assert dependency_problems(rules) == {}
    drive = Drive(detector(), *rules)
    reported = drive.take(
        *sorted(
            series("speed", "990999090990000000000000")
            + series("yaw-rate", "000020020000000000000000")
            + series("hazard", "000000000000010000000000")
        ),
        until=24,
    )
    started = {each for each in reported if "started" in each}
    assert {each for each in started if each.startswith(("braking-", "swerved", "stopping", "no-"))} == {
        "braking-often car started 9",
        "swerved-after-braking car started 5",
        "swerved-after-braking car started 8",
        "stopping-lasts car started 22",
        "no-hazard-lights car started 6",
    }, reported


def test_the_evaluation_modes_of_the_guide_work() -> None:
    rules = [EventRule.model_validate(each) for each in documents("When a rule is evaluated")]
    drive = Drive(detector(), *rules)
    samples = [arrival(seconds, "car", {"v": v}, "speed") for seconds, v in ((0.05, 5), (0.25, 40), (0.95, 5))]
    reported = drive.take(*samples, until=1)
    assert reported == [
        "every-100-ms car started 0.3",
        "each-sample car started 0.55",
        "each-sample car Until 0.95",
        "every-100-ms car Until 1",
    ]
    assert [each.when for each in drive.engine.evaluate_now("on-request")[1]] == [False]
