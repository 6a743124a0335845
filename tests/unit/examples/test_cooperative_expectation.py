"""The case cooperative recording: the expected detections of a drive, and drives that are clear enough to judge."""

from __future__ import annotations

import ast
import sys

import numpy as np
import pytest

from tests.guides import ROOT

EXAMPLE = ROOT / "examples" / "cooperative-recording"
sys.path.insert(0, str(EXAMPLE))  # its folder's name has a dash, so it is no package of ours

from cooperative_recording.expected import Episode, Fusion, Span, episodes, fusions, recorders  # noqa: E402
from cooperative_recording.seeds import (  # noqa: E402
    CLEAR_DURATIONS_S,
    CLEAR_SEEDS,
    DEMO_DURATION_S,
    DEMO_SEED,
    PLACE_LOOK,
    clear_seed,
    doubtful_pauses,
    unclear,
)
from cooperative_recording.vehicles import LIDAR_VEHICLES, Drive, Track, simulate  # noqa: E402


def test_the_expectation_shares_no_code_with_the_programs() -> None:
    for file in (EXAMPLE / "cooperative_recording").glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = [each.name for each in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            assert not {name.split(".")[0] for name in names} & {"detector", "application_manager", "wayside"}, file


@pytest.mark.parametrize("seed", CLEAR_SEEDS)
def test_expected_episodes_match_a_scan_of_every_hundredth_of_a_second(seed: int) -> None:
    drive = simulate(seed, 25)
    times = np.arange(0, 25, 0.01)
    where = {vehicle.name: drive.poses(vehicle.name, times)[:, :2] for vehicle in LIDAR_VEHICLES}
    found = []
    for a in sorted(where):
        for b in sorted(where):
            if a < b:
                near, start = False, 0.0
                for t, (dx, dy) in zip(times, where[a] - where[b], strict=True):
                    squared = dx * dx + dy * dy
                    if not near and squared < 150**2:
                        near, start = True, t
                    elif near and squared > 200**2:
                        near = False
                        found.append((a, b, start, t))
                if near:
                    found.append((a, b, start, 99.0))
    expected = [(*e.pair, e.start_s, 99.0 if e.end_s is None else e.end_s) for e in episodes(drive, 25)]
    assert [each[:2] for each in sorted(found)] == [each[:2] for each in sorted(expected)]
    for ours, theirs in zip(sorted(expected), sorted(found), strict=True):
        assert ours[2:] == pytest.approx(theirs[2:], abs=0.011)


def test_the_demo_shows_what_the_readme_promises() -> None:
    found = episodes(simulate(DEMO_SEED, DEMO_DURATION_S), DEMO_DURATION_S)
    assert [("+".join(e.pair), round(e.start_s, 1), round(e.end_s or -1, 1), e.place) for e in found] == [
        ("shuttle_1+shuttle_2", 0.0, 5.0, "west"),
        ("shuttle_1+taxi_1", 6.9, 19.2, "west"),
        ("shuttle_2+taxi_1", 8.3, 19.6, "west"),
        ("taxi_3+taxi_4", 8.8, 14.7, "east"),
        ("shuttle_1+shuttle_2", 11.6, 21.6, "west"),
    ]
    assert [(round(f.start_s, 1), f.sources) for f in fusions(found)["west"]] == [
        (0.0, ("shuttle_1", "shuttle_2")),
        (6.9, ("shuttle_1", "taxi_1")),
        (8.3, ("shuttle_1", "shuttle_2", "taxi_1")),
        (19.6, ("shuttle_1", "shuttle_2")),
    ]


@pytest.mark.parametrize("seed", CLEAR_SEEDS)
@pytest.mark.parametrize("duration", CLEAR_DURATIONS_S)
def test_the_listed_seeds_are_clear_and_eventful(seed: int, duration: float) -> None:
    assert unclear(simulate(seed, duration + PLACE_LOOK), duration) == []
    assert len(episodes(simulate(seed, duration), duration)) >= 4


def test_not_every_seed_is_clear() -> None:
    assert 0 < sum(clear_seed(seed) for seed in range(12)) < 12


def approaching(nearest: float, speed: float = 20.0) -> Drive:
    """shuttle_1 passes shuttle_2 after 10 s, `nearest` metres away; the other lidar vehicles stand far apart."""
    times, ones = np.array([0.0, 30.0]), np.ones(2)
    tracks = {
        vehicle.name: Track(times, ones, np.column_stack([1e6 * number * ones, 0 * ones, 0 * ones]))
        for number, vehicle in enumerate(LIDAR_VEHICLES, start=1)
    }
    tracks["shuttle_1"] = Track(times, speed * ones, np.column_stack([speed * (times - 10) - 500, 0 * ones, 0 * ones]))
    tracks["shuttle_2"] = Track(times, ones, np.column_stack([-500 * ones, nearest * ones, 0 * ones]))
    return Drive(0, 30.0, tracks)


@pytest.mark.parametrize(
    ("drive", "doubt"),
    [
        (approaching(148.0), "148.0 m grazes 150 m"),
        (approaching(152.0), "152.0 m grazes 150 m"),
        (approaching(197.0), "197.0 m grazes 200 m"),
        (approaching(20.0, speed=20.2), "at 0.0 s: 203.0 m grazes 200 m"),  # at the outset
        (approaching(144.0, speed=60.0), "beyond 150 m for only 1.4 s"),
        (approaching(140.0, speed=6.0), "crosses 150 m at only 2.2 m/s"),
    ],
)
def test_a_drive_that_grazes_a_threshold_is_not_clear(drive: Drive, doubt: str) -> None:
    assert doubt in " ".join(unclear(drive, 20.0))


@pytest.mark.parametrize("nearest", [0.0, 100.0, 140.0, 160.0, 190.0, 210.0])
def test_a_drive_that_keeps_away_from_the_thresholds_is_clear(nearest: float) -> None:
    assert unclear(approaching(nearest, speed=30.0), 20.0) == []


@pytest.mark.parametrize(("linger", "doubtful"), [(5.0, 0), (3.0, 2), (1.0, 0)])
def test_a_pause_about_as_long_as_the_linger_is_doubtful(linger: float, doubtful: int) -> None:
    found = [Episode(("a", "b"), start, end, "west") for start, end in ((1, 4), (7.2, 9), (40, None))]
    doubts = doubtful_pauses(found, linger)
    assert len(doubts) == doubtful, "one for the recorder, one for the fusion"
    assert all("at 4.0 s: a pause of 3.2 s is about the linger" in doubt for doubt in doubts)


def test_a_recorder_lingers_and_stays_if_demanded_again_meanwhile() -> None:
    pair, other = ("a", "b"), ("a", "c")
    found = [Episode(pair, 1, 4, "west"), Episode(pair, 5, 8, "west"), Episode(other, 2, None, "west")]
    assert recorders(found, linger_s=0) == {pair: [Span(1, 4), Span(5, 8)], other: [Span(2, None)]}
    assert recorders(found, linger_s=2) == {pair: [Span(1, 10)], other: [Span(2, None)]}


def test_a_fusion_has_the_vehicles_of_all_open_episodes_and_keeps_its_last_sources_while_it_lingers() -> None:
    found = [
        Episode(("a", "b"), 1, 4, "west"),
        Episode(("a", "c"), 2, 6, "west"),
        Episode(("a", "b"), 7, 9, "west"),
        Episode(("c", "d"), 3, None, "east"),
    ]
    assert fusions(found, linger_s=0) == {
        "west": [
            Fusion("west", 1, 2, ("a", "b")),
            Fusion("west", 2, 4, ("a", "b", "c")),
            Fusion("west", 4, 6, ("a", "c")),
            Fusion("west", 7, 9, ("a", "b")),
        ],
        "east": [Fusion("east", 3, None, ("c", "d"))],
    }
    west = fusions(found, linger_s=2)["west"]
    assert [(f.start_s, f.end_s) for f in west] == [(1, 2), (2, 4), (4, 7), (7, 11)]
