"""The examples in docs/scopes.md work as described."""

from __future__ import annotations

import re
from typing import Any

import pytest
import yaml

from tests.driving import Drive, a_detector, a_rule, a_stream, arrival
from tests.guides import guide, yaml_blocks
from wayside.rules import compile_rule

GUIDE = guide("scopes")
STREAMS = [a_stream(name) for name in ("pose", "gnss", "odometry")]
EXAMPLES: dict[str, dict[str, Any]] = {
    section.partition("\n")[0]: yaml.safe_load(block)
    for section in re.split(r"^## ", GUIDE, flags=re.MULTILINE)
    for block in yaml_blocks(section)
}
RULES = ("Pairs", "Fleet", "Each", "Parameters that follow")


def test_every_section_has_its_example() -> None:
    assert set(EXAMPLES) == {*RULES, "Clients that are known in advance", "Episodes beyond a restart"}


@pytest.mark.parametrize("section", RULES)
def test_a_rule_is_accepted(section: str) -> None:
    compile_rule(a_rule(**EXAMPLES[section]), a_detector(*STREAMS))


@pytest.mark.parametrize("section", sorted(EXAMPLES.keys() - {*RULES}))
def test_a_part_of_a_detector_is_accepted(section: str) -> None:
    spec = a_detector(*STREAMS, **EXAMPLES[section]).spec
    assert spec.clients or spec.state


def test_a_tram_and_a_car_that_approach_each_other() -> None:
    clients = [{"name": "tram", "labels": {"role": "tram"}}, {"name": "car", "labels": {"role": "car"}}]
    drive = Drive(a_detector(*STREAMS, clients=clients), a_rule(**EXAMPLES["Pairs"]))
    degree = 111_319.49  # metres along the equator
    still = [arrival(n + 0.5, "tram", {"lat": 0, "lon": 180}, "gnss") for n in range(12)]
    moving = [arrival(n + 0.6, "car", {"lat": 0, "lon": -180 + (90 - 10 * n) / degree}, "gnss") for n in range(12)]
    assert drive.take(*sorted(still + moving), until=12) == ["r tram+car started 5"]
    assert drive.events[0].values["closingSpeed"] == pytest.approx(10, abs=0.01)


def test_three_fast_buses_start_an_episode() -> None:
    clients = [{"name": f"bus{n}", "labels": {"role": "bus"}} for n in range(4)]
    drive = Drive(a_detector(*STREAMS, clients=clients), a_rule(**EXAMPLES["Fleet"]))
    speeds = [
        arrival(0.1 + n / 10, f"bus{n}", {"twist": {"twist": {"linear": {"x": x}}}}, "odometry")
        for n, x in enumerate((16, 20, 0, 17))
    ]
    assert drive.take(*speeds, until=1) == ["r ~fleet started 1"]
    assert drive.events[0].values["count"] == 3


def test_a_car_that_passes_a_site_starts_an_episode() -> None:
    drive = Drive(a_detector(*STREAMS), a_rule(**EXAMPLES["Each"]))
    reported = drive.take(*(arrival(n + 0.5, "car", {"x": 100 * n}, "pose") for n in range(7)), until=7)
    assert reported == ["r car~north started 2", "r car~north Until 3", "r car~south started 6", "r car~south Until 7"]
    assert not drive.engine.demands()


def test_the_sources_follow_the_present_clients() -> None:
    drive = Drive(a_detector(*STREAMS, clientTimeout="3s"), a_rule(**EXAMPLES["Parameters that follow"]))
    seen = []
    for second, clients in enumerate(("a", "ab", "b", "b", "b")):
        drive.take(*(arrival(second + 0.5, client, {"x": 0}, "pose") for client in clients), until=second + 1)
        (demand,) = drive.engine.demands().values()
        seen.append(demand.parameters["sources"])
    assert seen == [["a"], ["a", "b"], ["a", "b"], ["a", "b"], ["b"]]
