"""Finds the use cases, and runs one from its messages to the verdict."""

from __future__ import annotations

import importlib.util
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from examples.running.judging import Verdict, judge
from examples.running.playing import RECORDINGS, Played, play
from examples.running.recording import write_recording
from examples.running.scenario import Scenario

EXAMPLES = Path(__file__).resolve().parents[1]
SCENARIO = "scenario.py"


@dataclass(frozen=True, slots=True)
class CaseResult:
    """The result of a use case."""

    name: str
    scenario: Scenario
    played: Played
    verdict: Verdict
    messages: int
    took_s: float


def use_cases() -> list[str]:
    """The names of the folders that have a scenario and rules, sorted."""
    return sorted(each.parent.name for each in EXAMPLES.glob(f"*/{SCENARIO}") if (each.parent / "rules.yaml").is_file())


def folder_of(name: str) -> Path:
    """A use case's folder."""
    return EXAMPLES / name


def scenario_of(name: str) -> Scenario:
    """The scenario of a use case; its own folder is on the import path from then on.

    Raises:
        LookupError: there is no such folder, or no scenario in it.
    """
    file = folder_of(name) / SCENARIO
    if name not in use_cases():
        raise LookupError(f"{name}: no such use case: there are {', '.join(use_cases())}")
    module_name = f"examples.scenario_of_{name.replace('-', '_')}"
    if module_name not in sys.modules:
        sys.path.insert(0, str(file.parent))  # a folder's name may have a dash, so it is no package
        spec = importlib.util.spec_from_file_location(module_name, file)
        if spec is None or spec.loader is None:
            raise LookupError(f"{file}: cannot be imported: it must be a Python module")
        module = importlib.util.module_from_spec(spec)
        sys.modules[module_name] = module  # dataclasses look their module up
        spec.loader.exec_module(module)
    made: Scenario = sys.modules[module_name].scenario()
    return made


def run(name: str, output: Path) -> CaseResult:
    """Run a use case; what comes out goes below the output folder.

    Raises:
        LookupError: there is no such use case.
        RefusedError, DocumentError, DetectorError, RecordingError: one of its files cannot be used.
        OSError: the output cannot be written.
    """
    began = time.monotonic()
    scenario = scenario_of(name)
    shutil.rmtree(output / RECORDINGS, ignore_errors=True)  # of the run before
    output.mkdir(parents=True, exist_ok=True)
    recording = output / f"{name}.mcap"
    count = write_recording(scenario.messages(), recording)
    played = play(folder_of(name), recording, output)
    verdict = judge(scenario, played, folder_of(name))
    return CaseResult(name, scenario, played, verdict, count, time.monotonic() - began)
