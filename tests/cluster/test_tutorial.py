"""docs/tutorial.md shows the output of a run, with random names, times and ages normalised."""

from __future__ import annotations

import sys
from pathlib import Path

from tests.cluster.api import Api
from tests.cluster.controlplane import ControlPlane

sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / "cooperative-recording"))

from tutorial import GUIDE, blocks, play, staged


def test_the_tutorial_shows_the_output_of_a_run(control_plane: ControlPlane, api: Api, tmp_path: Path) -> None:
    shown = blocks(GUIDE.read_text(encoding="utf-8"))
    with staged(api, control_plane.binaries.kubectl, tmp_path) as stage:
        printed = play(stage)
    assert len(printed) == len(shown)
    for step, (expected, found) in enumerate(zip(shown, printed, strict=True)):
        assert found == expected, f"step {step}: rewrite it with examples/cooperative-recording/tutorial.py --write"
