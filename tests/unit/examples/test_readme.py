"""The README's commands: those of the first rule run unchanged, those for a cluster name existing files and options."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from typer.testing import CliRunner

from application_manager.commands import cli as manager
from detector.commands import cli as detector
from tests.guides import ROOT

APPS = {".venv/bin/detector": detector.app, ".venv/bin/application-manager": manager.app}
README = (ROOT / "README.md").read_text(encoding="utf-8")
FIRST_RULE = README.partition("## Your first rule\n")[2].partition("\n## ")[0]


class Step(NamedTuple):
    command: list[str]
    expected: list[list[str]]
    """Lines of the output, in words."""


def steps(text: str) -> Iterator[Step]:
    for block in re.findall(r"^```console\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            line, _, output = part.replace("\\\n", "").partition("\n")
            yield Step(
                shlex.split(line, comments=True), [words for each in output.splitlines() if (words := each.split())]
            )


def run(command: list[str]) -> str:
    """The output of the command; `>` redirects it into a file."""
    target = None
    if command[-2:-1] == [">"]:
        command, target = command[:-2], Path(command[-1])
    app = APPS.get(command[0])
    if app is not None:
        result = CliRunner().invoke(app, command[1:], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        output = result.stdout if target is not None else result.output
    else:
        program = sys.executable if command[0] == ".venv/bin/python" else command[0]
        output = subprocess.run([program, *command[1:]], check=True, capture_output=True, text=True).stdout
    if target is not None:
        target.write_text(output)
        return ""
    return output


def test_the_readme_shows_the_results_of_its_first_rule(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for text, name in re.findall(r"^```\w+\n(# (\w+\.\w+).*?)^```", FIRST_RULE, re.MULTILINE | re.DOTALL):
        Path(name).write_text(text)
    done = 0
    for command, expected in steps(FIRST_RULE):
        found = [words for line in run(command).splitlines() if (words := line.split())]
        assert found == expected or not expected, command
        done += 1
    assert done > 7
    for name in ("report.html", "results.mcap", "layout.json", "episodes.parquet", "episodes.csv"):
        assert (Path("out") / name).stat().st_size > 0


OTHERS = [step.command for step in steps(README) if step not in [*steps(FIRST_RULE)]]


@pytest.mark.parametrize("command", OTHERS, ids=" ".join)
def test_commands_that_need_a_cluster_have_existing_files_and_options(command: list[str]) -> None:
    assert command[0] in {"docker", "helm", "kubectl", *APPS}, "a command of another kind: run it in this test"
    for word in command[1:]:
        if re.match(r"(examples|charts|crds)\b", word):
            assert (ROOT / word).exists(), word
    app = APPS.get(command[0])
    if app is not None:
        shown = CliRunner().invoke(app, [command[1], "--help"], env={"COLUMNS": "200"})
        assert shown.exit_code == 0, shown.output
        for option in (word for word in command if word.startswith("--")):
            assert option in shown.output


def test_the_make_targets_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = set(re.findall(r"`make ([a-z-]+)", README))
    assert {"demo", "test"} <= named <= targets
