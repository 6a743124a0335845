"""`detector new`: each draft passes the check and finds its event in a drive."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from detector.commands.cli import app
from detector.commands.drafts import drafts
from tests.driving import START, a_detector
from tests.recorded import write_json_lines

EXAMPLES = Path(__file__).parents[3] / "examples"
STREAM = {"name": "state", "key": "vehicles/${client:*}/state", "encoding": "json"}


def drive(path: Path) -> None:
    """Two cars meet and stand still; car1 becomes hot and leaves the area; both brake hard at the eighth second."""
    messages = []
    for step in range(400):
        at = step / 10
        for car in range(2):
            moving = at < 8
            x = (at * 10 - 80) * (1 - 2 * car) if moving else 5.0 * car
            y = 200.0 if car and at > 30 else 0.0
            value = {"x": x, "y": y, "speed": 10.0 if moving else 0.0, "temperature": 20 + at * (1 + car)}
            messages.append((START + step * 10**8, f"vehicles/car{car}/state", value))
    write_json_lines(path, messages)


@pytest.mark.parametrize("case", drafts())
def test_each_draft_passes_the_check_and_finds_an_episode(tmp_path: Path, case: str) -> None:
    assert (EXAMPLES / case / "rules.yaml").exists()
    drive(tmp_path / "drive.jsonl")
    detector, rule = tmp_path / "detector.yaml", tmp_path / "rule.yaml"
    detector.write_text(json.dumps(a_detector(STREAM, recordings={"path": "clips"}).to_json()))
    made = CliRunner().invoke(app, ["new", case, "--stream", "state", "--name", "mine"])
    assert made.exit_code == 0, made.output
    rule.write_text(made.stdout)
    checked = CliRunner().invoke(app, ["check", str(detector), str(rule), "--strict"])
    assert checked.exit_code == 0, checked.output
    files = [str(tmp_path / "drive.jsonl"), "--detector", str(detector), "--rules", str(rule)]
    replayed = CliRunner().invoke(app, ["replay", *files, "--output", str(tmp_path / "out")])
    assert replayed.exit_code == 0, replayed.output
    events = [json.loads(line) for line in (tmp_path / "out/events.jsonl").read_text().splitlines()]
    assert events, replayed.output
    assert {event["data"]["rule"] for event in events} == {"mine"}


def test_without_an_argument_the_drafts_are_listed_and_an_unknown_one_is_named() -> None:
    listed = CliRunner().invoke(app, ["new"])
    assert [line.split()[0] for line in listed.output.splitlines()] == [*drafts()]
    assert "there is no use case potholes; the use cases are battery-health" in str(
        CliRunner().invoke(app, ["new", "potholes"]).exception
    )
