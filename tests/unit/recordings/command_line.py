"""Runs the command line in a folder with a Detector, a rule and recordings."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from detector.commands.cli import main
from tests.driving import a_detector, a_rule, a_stream, at
from tests.unit.recordings.test_recordings import write_lines


class CommandResult(NamedTuple):
    code: int
    logged: str
    events: list[dict[str, Any]]


class CommandLine:
    """A folder with a Detector, a rule and recordings, and the command."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder = folder
        self._monkeypatch = monkeypatch
        self._capsys = capsys
        self.write(a_detector(a_stream("speed")), a_rule("fast", **FAST))

    def write(self, *objects: Any, **spec: Any) -> None:
        documents = [each if isinstance(each, dict) else each.to_json() for each in objects]
        (self.folder / "detector.yaml").write_text(yaml.safe_dump_all(d for d in documents if d["kind"] == "Detector"))
        (self.folder / "rules.yaml").write_text(yaml.safe_dump_all(d for d in documents if d["kind"] == "EventRule"))

    def drive(self, name: str, *samples: tuple[float, object], key: str = "vehicles/car/speed") -> Path:
        """JSON lines; times are seconds after the start."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return write_lines(path, *({"t": at(time), "key": key, "value": value} for time, value in samples))

    def run(self, *arguments: str) -> CommandResult:
        self._monkeypatch.setattr(sys, "argv", ["detector", *arguments])
        self._monkeypatch.chdir(self.folder)
        with pytest.raises(SystemExit) as left:
            main()
        events = self.folder / "out" / "events.jsonl"
        found = [json.loads(line) for line in events.read_text().splitlines()] if events.exists() else []
        return CommandResult(int(left.value.code or 0), self._capsys.readouterr().err, found)

    def replay(self, *recordings: str | Path, options: Sequence[str] = ()) -> CommandResult:
        given = ["--detector", "detector.yaml", "--rules", "rules.yaml", "--output", "out"]
        return self.run("replay", *map(str, recordings), *given, *options)


FAST: dict[str, Any] = {
    "signals": [{"name": "v", "stream": "speed", "value": "msg.v"}],
    "when": "v > 10",
    "until": "v < 5",
}
