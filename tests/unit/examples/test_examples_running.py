"""The use cases: each gives the results of its own truth, and the runner detects differences."""

from __future__ import annotations

import dataclasses
import re
import sys
from pathlib import Path

import pytest

from detector.commands import cli
from examples.running.__main__ import main
from examples.running.cases import CaseResult, folder_of, run, scenario_of, use_cases
from examples.running.demanding import RunningTask, unlike
from examples.running.judging import judge
from examples.running.playing import Played, play
from examples.running.recording import write_recording
from examples.running.scenario import Episode, Moment, Scenario
from tests.guides import guide
from wayside.process import commandline


@pytest.fixture(scope="module", params=use_cases())
def ran(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> CaseResult:
    """A use case that was run."""
    return run(request.param, tmp_path_factory.mktemp(request.param))


def test_a_use_case_gives_the_results_of_its_truth(ran: CaseResult) -> None:
    assert ran.verdict.problems == []
    assert ran.verdict.expected == ran.verdict.found > 0
    assert ran.verdict.actions_expected == ran.verdict.actions_done > 0


def test_a_use_case_without_results_is_reported(ran: CaseResult, tmp_path: Path) -> None:
    problems = judge(ran.scenario, Played(tmp_path), folder_of(ran.name)).problems
    assert {each.split(" of ")[0] for each in problems if " starts never; expected: " in each} == {
        each.rule for each in ran.scenario.episodes
    }
    assert {each.split(" was done 0 times")[0] for each in problems if " was done 0 times" in each} == {
        *ran.scenario.actions
    }


def test_a_use_case_is_reported_with_its_picture_and_files(ran: CaseResult) -> None:
    folder, picture = folder_of(ran.name), ran.scenario.picture_file
    readme = (folder / "README.md").read_text(encoding="utf-8")
    assert f"]({picture})" in readme
    assert f"examples.running {ran.name}" in readme
    assert (folder / picture).read_text(encoding="utf-8") == ran.scenario.picture()


@pytest.mark.parametrize("name", use_cases())
def test_the_files_of_a_use_case_have_no_findings(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    files = sorted(map(str, folder_of(name).glob("*.yaml")))
    assert commandline.run_cli(cli.app, "detector", (), ["check", *files]) == 0
    logged = capsys.readouterr()
    assert logged.out == ""
    assert "no errors" in logged.err


def test_the_guide_describes_all_of_them() -> None:
    text = guide("use-cases")
    assert set(re.findall(r"\(\.\./examples/([a-z-]+)\)", text)) == set(use_cases())
    fields = {each.name for each in dataclasses.fields(Scenario)}
    assert set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)) <= fields


def test_differences_are_reported(tmp_path: Path) -> None:
    scenario = scenario_of("battery-health")
    recording = tmp_path / "drive.mcap"
    write_recording(scenario.messages(), recording)
    played = play(folder_of("battery-health"), recording, tmp_path)
    late, *others = scenario.episodes
    wrong = dataclasses.replace(
        scenario,
        episodes=[dataclasses.replace(late, start_s=late.start_s - 10), *others, Episode("battery-health", "bus-1", 3)],
        actions={**scenario.actions, "battery-report/data": 3},
        check=lambda played: ["the operator sleeps"],
    )
    problems = judge(wrong, played, folder_of("battery-health")).problems
    assert [problem.split(";")[0].split(" at ")[0] for problem in problems] == [
        "battery-health of bus-1 starts never",
        f"battery-health of {late.subject} starts",
        "battery-report/data was done 2 times",
        "the operator sleeps",
    ]


def test_differing_applications_are_reported() -> None:
    moment = Moment(3, {"driving/a": {"maxSpeed": 4}, "driving/b": {}})
    right = {
        "driving/a": RunningTask(("Deployment",), {"maxSpeed": 4, "vehicle": "a"}),
        "driving/b": RunningTask(("Pod",)),
    }
    assert list(unlike(moment, right)) == []
    wrong = {"driving/a": RunningTask(("Deployment",), {"maxSpeed": 13.9}), "driving/c": RunningTask(())}
    assert [problem.split(":")[0].split(" is ")[0] for problem in unlike(moment, wrong)] == [
        "at 3 s driving/a",
        "at 3 s driving/b does not run",
        "at 3 s driving/c runs; it must not",
    ]
    asleep = {**right, "driving/b": RunningTask(("Pod",), suspended=True)}
    assert list(unlike(moment, asleep)) == ["at 3 s driving/b is suspended"]
    assert list(unlike(dataclasses.replace(moment, suspended=["driving/b"]), asleep)) == []


def test_the_command_reports_differences_by_its_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def command(*arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", ["examples.running", *arguments])
        return main()

    assert command("no-such") == 2
    logged = capsys.readouterr()
    assert logged.out == ""
    assert "no such use case: no-such" in logged.err
    assert command("battery-health", "--output", str(tmp_path)) == 0
    assert "as it must be" in capsys.readouterr().out
    assert (tmp_path / "battery-health" / "events.jsonl").is_file()
