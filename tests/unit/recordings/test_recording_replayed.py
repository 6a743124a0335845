"""`detector replay` reads back what the record action wrote; `detector check` wants to know where recordings go."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from detector.assembly.checking import findings
from detector.replay.message import RecordingError
from detector.replay.recordings import types_of
from detector.testing import run
from tests.driving import a_detector, a_rule, a_stream, at
from tests.recorded import messages_in
from tests.recording_bench import STREAMS, Bench, an_episode, mcap_files, pose, read_with_mcap, speed, tf_static
from tests.unit.recordings.command_line import FAST, CommandLine
from wayside.api.documents import load_documents
from wayside.times import parse_time

DETECTOR = """
apiVersion: wayside.dev/v1alpha1
kind: Detector
metadata: {name: d}
spec:
  streams:
    - {name: speed, key: 'vehicles/${client:*}/speed', encoding: json}
    - {name: pose, key: 'vehicles/${client:*}/pose', encoding: cdr, type: geometry_msgs/msg/PoseStamped}
"""
RULE = """
apiVersion: wayside.dev/v1alpha1
kind: EventRule
metadata: {name: fast}
spec:
  evaluation: {every: 100ms}
  signals: [{name: speed, stream: speed, value: msg.v}]
  when: speed > 10
  actions:
    - name: bag
      record: {before: 5s}
"""


def test_a_replay_reads_messages_at_their_times_and_latched_ones_once(tmp_path: Path) -> None:
    bench = Bench(tmp_path, split={"duration": "1s"})
    given = [tf_static(1.0), *(each for k in range(30) for each in (pose(1 + k / 10, k), speed(1.05 + k / 10, k)))]
    folder = bench.record(an_episode(), given)
    assert len(mcap_files(folder)) == 3
    found = list(messages_in([folder]))
    assert [(each.time, f"vehicles/{each.key.split('/', 1)[1]}", each.payload) for each in found] == [
        (each.time, each.key, each.payload) for each in given
    ]
    assert {(each.encoding, each.type) for each in found} == {
        ("cdr", "tf2_msgs/msg/TFMessage"),
        ("cdr", "geometry_msgs/msg/PoseStamped"),
        ("json", None),
    }
    assert {each.name for each in types_of(folder)} == {"tf2_msgs/msg/TFMessage", "geometry_msgs/msg/PoseStamped"}


def test_a_replay_of_a_recording_gives_the_event_again(tmp_path: Path) -> None:
    (tmp_path / "d.yaml").write_text(DETECTOR)
    (tmp_path / "r.yaml").write_text(RULE.partition("  actions:")[0])
    bench = Bench(tmp_path / "recordings", *STREAMS[:3])
    folder = bench.record(an_episode(), [speed(1 + k / 10, 20 if 10 <= k < 20 else 5) for k in range(40)])
    events = run(tmp_path / "r.yaml", tmp_path / "d.yaml", folder)
    assert [(event.episode.subject, event.started) for event in events] == [("car1", True), ("car1", False)]
    assert events[0].episode.start_time == at(2.0)


def test_a_missing_file_of_a_recording_is_reported(tmp_path: Path) -> None:
    folder = Bench(tmp_path).record(an_episode(), [pose(1.1)])
    (file,) = mcap_files(folder)
    file.unlink()
    with pytest.raises(RecordingError, match=f"{file.name} is missing"):
        list(messages_in([folder]))


def problems(tmp_path: Path, detector: str, rule: str) -> list[str]:
    path = tmp_path / "both.yaml"
    path.write_text(f"{detector}---{rule}")
    return [str(each).removeprefix(f"{path}:") for each in findings(load_documents([path])).problems]


def test_a_record_action_needs_a_recordings_folder(tmp_path: Path) -> None:
    (found,) = problems(tmp_path, DETECTOR, RULE)
    assert "spec.actions[0].record: Detector d has no spec.recordings: add it" in found
    assert found.startswith("19:15: ")
    assert problems(tmp_path, f"{DETECTOR}  recordings: {{path: /var/lib/wayside}}\n", RULE) == []


def test_errors_in_metadata_are_reported_by_field(tmp_path: Path) -> None:
    rule = RULE.replace("{before: 5s}", "{metadata: {fine: '${speed}', wrong: '${sped}'}}")
    (found,) = problems(tmp_path, f"{DETECTOR}  recordings: {{path: /var/lib/wayside}}\n", rule)
    assert found.startswith("20:52: spec.actions[0].record.metadata.wrong: ")
    assert "sped" in found


def test_a_window_that_reaches_further_back_than_the_buffer_is_refused(tmp_path: Path) -> None:
    rule = RULE.replace("5s", "50s")
    found = problems(tmp_path, f"{DETECTOR}  recordings: {{path: /var/lib/wayside}}\n", rule)
    assert "record.before: 50s exceeds the 10 s that Detector d keeps of stream speed" in found[0]
    assert found[0].startswith("20:24: ")


def test_a_replay_extracts_the_windows_of_record_actions(command: CommandLine) -> None:
    """One episode is whole; the other is still open when the recording ends, so its clip is cut and marked as such."""
    window = {"before": "500ms", "after": "1s"}
    rule = a_rule("fast", **FAST, actions=[{"name": "bag", "record": {**window, "split": {"duration": "1s"}}}])
    command.write(a_detector(a_stream("speed"), buffer={"duration": "2s"}), rule)
    speeds = {k / 10: {"v": 20 if 20 <= k < 40 or k >= 90 else 1, "n": k} for k in range(100)}
    path = command.drive("drive.jsonl", *((time, value) for time, value in speeds.items()))
    for _ in range(2):  # clips of the replay before are replaced
        ran = command.replay(path, options=["--record"])
        assert (ran.code, len(ran.events)) == (0, 3), ran.logged
        assert "2 clips: out" in ran.logged
        assert "1 of 2 clips of action bag, EventRule fast, are not whole: the recording ended" in ran.logged
        whole, cut = sorted((command.folder / "out" / "clips" / "fast").iterdir())
        assert cut.name.endswith("_cut")
    reported = json.loads((whole / "recording.json").read_text())
    assert (reported["episode"], reported["reason"]) == (ran.events[0]["data"]["episode"], "Until")
    onset, end = (parse_time(reported[name]) for name in ("onsetTime", "endTime"))
    files = mcap_files(whole)
    assert len(files) > 1
    found = [json.loads(each.payload)["n"] for file in files for each in read_with_mcap(file)]
    assert found == [value["n"] for t, value in speeds.items() if onset - 5 * 10**8 < at(t) <= end + 10**9]


def test_a_replay_without_record_runs_no_action(command: CommandLine) -> None:
    command.write(
        a_detector(a_stream("speed"), recordings={"path": "live"}),
        a_rule("fast", **FAST, actions=[{"name": "bag", "record": {}}]),
    )
    path = command.drive("drive.jsonl", (0.5, {"v": 20}), (3.5, {"v": 1}), (5.0, {"v": 1}))
    assert len(command.replay(path).events) == 2
    assert len(command.replay(path, options=["--record"]).events) == 2
    assert not (command.folder / "live").exists()
    assert [each.name for each in (command.folder / "out" / "clips").iterdir()] == ["fast"]
