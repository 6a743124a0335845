"""Two rules over the same recording: a learning-based and a rule-based one, matched episode by episode."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from detector.commands import cli
from detector.engine.episodes.episodes import EndReason
from detector.engine.episodes.events import Event
from detector.engine.episodes.record import EpisodeRecord
from detector.results.variants import compare
from tests import onnx_models
from tests.driving import START, a_detector, a_rule, at
from tests.recorded import write_json_lines
from wayside.inputerror import InputError
from wayside.process.commandline import run_cli


def episodes(rule: str, *spans: tuple[float, float | None], subject: str = "car") -> list[Event]:
    """Events of episodes from and to seconds after the start; None: still open."""
    events = []
    for first, last in spans:
        episode = EpisodeRecord(
            f"{rule}{subject}{first}", rule, subject, (subject,), None, at(first), at(first), {}, None
        )
        for end in (None, last):
            if end is None or last is not None:
                ended = () if end is None else (at(end), EndReason.UNTIL)
                events.append(Event("h", episode, {}, *ended))
    return events


def test_overlapping_episodes_match_and_their_times_are_compared() -> None:
    events = [*episodes("a", (0, 10), (20, 30), (50, 60)), *episodes("b", (1, 12), (40, 45), (49, 60))]
    comparison = compare(events, "a", "b", at(100))
    assert comparison.start_differences == [1.0, -1.0]
    assert [span.start for span in comparison.only_first] == [at(20)]
    assert [span.start for span in comparison.only_second] == [at(40)]
    assert comparison.agreement == (9 + 10) / (12 + 10 + 5 + 11)


def test_an_open_episode_ends_with_the_recording_and_its_end_is_not_compared() -> None:
    comparison = compare([*episodes("a", (0, None)), *episodes("b", (5, 10))], "a", "b", at(20))
    assert comparison.start_differences == [5.0]
    assert comparison.agreement == 5 / 20


def test_episodes_match_only_for_the_same_subject_and_by_the_longest_overlap() -> None:
    events = [*episodes("a", (0, 10)), *episodes("b", (0, 10), subject="bus"), *episodes("b", (0, 1), (2, 10))]
    comparison = compare(events, "a", "b", at(10))
    assert [(first.start, second.start) for first, second in comparison.both] == [(at(0), at(2))]
    assert [span.subject for span in comparison.only_second] == ["car", "bus"]


spans = st.lists(st.tuples(st.integers(0, 50), st.integers(0, 10)), max_size=8).map(
    lambda pairs: [(float(first), float(first + length)) for first, length in pairs]
)


@given(spans, spans)
def test_each_episode_is_counted_once_and_only_overlapping_ones_match(
    first: list[tuple[float, float]], second: list[tuple[float, float]]
) -> None:
    first, second = [*dict.fromkeys(first)], [*dict.fromkeys(second)]
    events = [*episodes("a", *dict(first).items()), *episodes("b", *dict(second).items())]
    comparison = compare(events, "a", "b", at(100))
    assert len(comparison.both) + len(comparison.only_first) == len(dict(first))
    assert len(comparison.both) + len(comparison.only_second) == len(dict(second))
    assert all(one.shared(other) >= 0 for one, other in comparison.both)


def test_a_learning_based_and_a_rule_based_rule_over_one_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = onnx_models.weighted(tmp_path / "m.onnx", [0.25] * 4)  # the mean of the last four speeds
    speed = {"name": "v", "stream": "speed", "value": "msg.v"}
    risk = {
        "name": "mean",
        "model": {"file": str(model), "inputs": [{"name": "x", "window": {"signals": ["v"], "last": 4}}]},
    }
    learned = a_rule("learned", signals=[speed, risk], when="mean > 10")
    threshold = a_rule("threshold", signals=[speed], when="v > 10")
    (tmp_path / "detector.yaml").write_text(json.dumps(a_detector().to_json()))
    (tmp_path / "rules.yaml").write_text("\n---\n".join(json.dumps(rule.to_json()) for rule in (learned, threshold)))
    speeds = [0] * 5 + [20] * 10 + [0] * 10 + [20] + [0] * 10  # the last is too short for the mean
    write_json_lines(
        tmp_path / "drive.jsonl",
        ((START + round((n + 0.5) * 1e9), "vehicles/car/speed", {"v": value}) for n, value in enumerate(speeds)),
    )
    files = ["--detector", str(tmp_path / "detector.yaml"), "--rules", str(tmp_path / "rules.yaml")]
    command = ["replay", str(tmp_path / "drive.jsonl"), *files, "--output", str(tmp_path / "out")]
    assert run_cli(cli.app, "detector", (InputError,), [*command, "--set", "threshold=learned"]) == 0
    table = [line.split() for line in capsys.readouterr().err.splitlines()]
    assert ["threshold", "as", "written", "2"] in table
    assert ["rule", "learned", "1", "1", "+0", "-1", "+2.00", "s"] in [line[:8] for line in table]
    (compared,) = json.loads((tmp_path / "out" / "variants.json").read_text())
    assert (compared["rule"], compared["variant"]) == ("threshold", "rule learned")
    assert [each["startDifference"] for each in compared["both"]] == [2.0]
    events = (tmp_path / "out" / "events.jsonl").read_text()
    assert {json.loads(line)["data"]["rule"] for line in events.splitlines()} == {"threshold", "learned"}
    assert run_cli(cli.app, "detector", (InputError,), [*command, "--set", "threshold=lerned"]) == 2
    assert "--set threshold=lerned: there is no rule lerned; did you mean learned?" in capsys.readouterr().err
