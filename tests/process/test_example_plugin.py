"""The example package is installed like a user's, checked, tested with the kit, and run by the commands."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from detector.testing import RefusedError, run
from tests.process.installing import installed

EXAMPLE = Path(__file__).parents[2] / "examples" / "signal-plugin"
RULES, DETECTOR, DRIVE = (EXAMPLE / name for name in ("rules.yaml", "detector.yaml", "drive.jsonl"))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with the installed package."""
    return installed(EXAMPLE, tmp_path_factory.mktemp("site"))


def test_a_plugin_that_is_not_installed_is_reported_missing() -> None:
    with pytest.raises(RefusedError, match=r"plugin\.name: no plugin stop-and-go is installed"):
        run(RULES, DETECTOR, DRIVE)


def test_the_rule_is_tested_in_three_lines(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(site)
    events = run(RULES, DETECTOR, DRIVE)
    assert [event.episode.subject for event in events if event.started] == ["jammed"]
    assert events[0].values == {"stops": 3.0}


def test_a_rule_not_selected_by_the_detector_is_an_error(tmp_path: Path) -> None:
    picky = tmp_path / "detector.yaml"
    picky.write_text(DETECTOR.read_text() + "  ruleSelector: {matchLabels: {site: x}}\n")
    with pytest.raises(RefusedError, match="stop-and-go"):
        run(RULES, picky, DRIVE)


def test_the_readme_has_the_same_three_lines() -> None:
    readme = (EXAMPLE / "README.md").read_text()
    code = readme.split("```python\n")[1].split("```")[0]
    assert len([line for line in code.splitlines() if line]) == 3
    assert 'run("rules.yaml", "detector.yaml", "drive.jsonl")' in code
    assert code in (EXAMPLE.parents[1] / "docs" / "plugins.md").read_text()


def test_the_commands_find_the_plugin_and_give_the_same_events(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = os.pathsep.join([str(site), *filter(None, sys.path)])
    command = [sys.executable, "-m", "detector.commands.cli"]

    def detector(*arguments: object) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*command, *map(str, arguments)],
            env={**os.environ, "PYTHONPATH": path},
            capture_output=True,
            text=True,
            check=True,
        )

    assert "no errors" in detector("check", DETECTOR, RULES).stderr
    detector("replay", DRIVE, "--detector", DETECTOR, "--rules", RULES, "--output", tmp_path)
    monkeypatch.syspath_prepend(site)
    events = (tmp_path / "events.jsonl").read_text().splitlines()
    assert events == [event.to_json() for event in run(RULES, DETECTOR, DRIVE)]
    assert json.loads(events[0])["subject"] == "jammed"
