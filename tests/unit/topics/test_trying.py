"""`detector try`: an expression and a recording in, a line for each client out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from detector.commands.cli import app
from tests.unit.topics.test_topics import drive, two_cars


def tried(*arguments: str | Path) -> Any:
    return CliRunner().invoke(app, ["try", *map(str, arguments)])


def test_a_number_has_its_extremes_its_mean_and_a_plot_for_each_client(tmp_path: Path) -> None:
    messages = [(at / 10, f"v/{car}/speed", {"v": at}) for at in range(101) for car in ("car1", "car2")]
    result = tried("msg.v * 2", drive(tmp_path, *messages))
    assert result.exit_code == 0, result.output
    first, *lines = result.output.splitlines()
    assert first == "msg.v * 2 of stream speed"
    assert [line.split()[0] for line in lines] == ["car1", "car2"]
    assert lines[0].endswith("min 0, mean 99, max 200")
    assert lines[0].split()[1][0] == "▁"
    assert lines[0].split()[1][-1] == "█"


def test_a_boolean_shows_its_share_of_time_true_and_a_text_its_value(tmp_path: Path) -> None:
    messages = [(at / 10, "v/car1/state", {"v": at, "gear": "D" if at < 50 else "N"}) for at in range(101)]
    recording = drive(tmp_path, *messages)
    assert "true 50% of the time" in tried("msg.v >= 50", recording).output
    assert tried("msg.gear", recording).output.splitlines()[1].split()[1:] == ["D,", "N"]


@pytest.mark.parametrize(
    ("expression", "options", "words"),
    [
        ("msg.w", [], "msg has no field w"),
        ("msg.v >", [], "msg.v >"),
        ("msg.v", ["--stream", "imu"], "--stream imu: there is no such stream; the streams"),
        ("msg.v", ["--every", "often"], "must be a duration"),
        ("1", [], "fits the streams odom, state: give --stream odom"),
    ],
)
def test_invalid_input_is_rejected_with_the_remedy(
    tmp_path: Path, expression: str, options: list[str], words: str
) -> None:
    result = tried(expression, two_cars(tmp_path), *options)
    assert result.exit_code != 0
    assert words in f"{result.output} {result.exception}".replace("\n", " ").replace("│", "")
