"""Test a rule in three lines: which events would it have produced in this drive?

    from detector.testing import run
    events = run("rules.yaml", "detector.yaml", "drive.mcap")
    assert [event.episode.subject for event in events if event.started] == ["car1"]

The engine is the same as in live operation. Plugins run in the test's process, so breakpoints and coverage see them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from detector.assembly import lasting_problems
from detector.engine.episodes.events import Event
from detector.replay.gathering import intake_file_of, recordings_of
from detector.replay.intake_file import read_intake
from detector.replay.playing import play
from detector.replay.replaying import replay_intake
from detector.resources.files import load_rules

__all__ = ["Event", "RefusedError", "run"]

Paths = str | Path | Sequence[str | Path]
"""One file or folder, or several."""


class RefusedError(ValueError):
    """A rule that is not evaluated; the message gives the reason and the place."""


def run(rules: Paths, detector: str | Path, recording: Paths, *, as_one: bool = False) -> list[Event]:
    """The events of these rules over a recording, in order.

    Args:
        rules: files or folders with EventRules.
        detector: the file with the Detector that evaluates them.
        recording: of any kind that `detector replay` reads. Several are replayed one after another, each on its own;
            `as_one`: as one, merged by time.

    Raises:
        RefusedError: a rule has problems, or the Detector does not select it.
        DocumentError, DetectorError, RecordingError: a file cannot be used.
    """
    loaded = load_rules(detector, _paths(rules), lasting_problems)
    if loaded.warnings:
        raise RefusedError("; ".join(loaded.warnings))
    recordings = _paths(recording)
    intake = intake_file_of(recordings)
    if intake is not None:
        outcomes = [replay_intake(read_intake(intake), loaded.rule_set.detector, loaded.rule_set.rules)]
    else:
        gathered = recordings_of(recordings, as_one=as_one)
        played = play(gathered, loaded.rule_set.detector, loaded.rule_set.rules)
        if played.errors:
            raise played.errors[0]
        outcomes = list(played.outcomes.values())
    refusals = dict.fromkeys(str(refusal) for outcome in outcomes for refusal in outcome.refusals)
    if refusals:
        raise RefusedError("; ".join(refusals))
    return [event for outcome in outcomes for event in outcome.events]


def _paths(given: Paths) -> list[Path]:
    return [Path(given)] if isinstance(given, str | Path) else [Path(each) for each in given]
