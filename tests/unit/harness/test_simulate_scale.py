"""The simulation behind docs/scale.md matches manual counts."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from benchmarks.simulate_scale import Assumptions, assumptions, most_open, spans, tasks_of, waits

SEED = 1


def test_tasks_of_an_episode_overlap_and_cover_it() -> None:
    assumed = Assumptions(speed=30, minutes=10)
    starts, ends, episodes = tasks_of(20_000, 9, assumed, np.random.default_rng(SEED))
    assert len(starts) > len(set(episodes)), "some vehicles cross a border"
    for episode in range(50):
        mine = np.flatnonzero(episodes == episode)
        for before, after in itertools.pairwise(mine):
            assert starts[after] <= ends[before] <= starts[after] + assumed.strip / assumed.speed
    begin, end = spans(starts, ends, episodes)
    assert most_open(begin, end) < most_open(starts, ends), "an episode has one application, near a border two tasks"
    assert (end - begin).mean() == pytest.approx(600, rel=0.05)


def test_vehicles_of_one_region_cross_no_border() -> None:
    starts, _, episodes = tasks_of(20_000, 1, Assumptions(), np.random.default_rng(SEED))
    assert len(starts) == len(set(episodes))


def test_open_tasks_are_counted_at_their_most() -> None:
    assert most_open(np.array([0.0, 10, 20, 30]), np.array([15.0, 25, 26, 40])) == 2


def test_a_simulated_manager_serves_tasks_one_by_one() -> None:
    found = waits(np.array([0.0, 1, 1, 10]), 2.0, 1, np.random.default_rng(SEED))
    assert sorted(found) == [0, 0, 0, 1, 3]  # the first 0 stands for an empty queue


def test_an_unknown_or_non_numeric_assumption_is_rejected() -> None:
    assert assumptions(["episodes=2"]).episodes == 2
    for given, problem in (
        ("episode=2", "there are load, "),
        ("episodes=two", "is not a number"),
        ("load=0", "above 0"),
    ):
        with pytest.raises(ValueError, match=problem):
            assumptions([given])
