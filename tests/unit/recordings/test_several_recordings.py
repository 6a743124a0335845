"""`detector replay` over several files: their grouping into recordings, which are independent of each other."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from detector.engine.samples.sample import Arrival
from detector.engine.timing.steps import ORDER
from detector.replay.gathering import recordings_of
from detector.replay.intake_writer import IntakeWriter
from detector.replay.message import RecordingError
from detector.replay.recordings import span_of
from detector.replay.rosbag1 import ROSBAG1_MAGIC
from tests.driving import a_deploy, a_detector, a_rule, a_stream, at
from tests.unit.recordings.command_line import FAST, CommandLine
from tests.unit.recordings.test_recordings import MESSAGES, write_bag, write_mcap

LEFT_OPEN = [(0.5, {"v": 20}), (4.0, {"v": 20})]
YEAR = 365 * 24 * 3600.0


def test_several_recordings_are_independent_of_each_other(command: CommandLine) -> None:
    """An episode that is open at the end of the first does not continue in the second, a year later."""
    command.drive("a.jsonl", *LEFT_OPEN)
    command.drive("b.jsonl", *((YEAR + time, {"v": 4}) for time in (0.0, 2.0, 4.0)))
    (alone,) = command.replay("a.jsonl").events + command.replay("b.jsonl").events
    assert alone["type"] == "dev.wayside.event.started"
    assert command.replay("a.jsonl", "b.jsonl").events == [{**alone, "recording": "a.jsonl"}]
    (second,) = command.replay("b.jsonl", "a.jsonl").events
    assert (second["recording"], second["source"]) == ("a.jsonl", "/detectors/d.2")
    assert [second[name] for name in ("type", "subject", "time")] == [
        alone[name] for name in ("type", "subject", "time")
    ]
    assert {**second["data"], "episode": ""} == {**alone["data"], "episode": ""}
    as_one = command.replay("a.jsonl", "b.jsonl", options=["--as-one"]).events
    assert [event["type"] for event in as_one] == ["dev.wayside.event.started", "dev.wayside.event.ended"]


def test_simulated_recordings_that_all_begin_at_the_same_time_do_not_mix(command: CommandLine) -> None:
    for run in range(3):
        command.drive(f"run_{run}.jsonl", (0.5, {"v": 20 if run == 1 else 1}), (4.0, {"v": 1}))
    ran = command.replay("run_0.jsonl", "run_1.jsonl", "run_2.jsonl")
    assert "3 recordings, 6 samples, 1 episode started, 1 ended, 0 tasks" in ran.logged
    command.write(a_detector(a_stream("speed")), a_rule("fast", **FAST, actions=[a_deploy("help")]))
    command.drive("run_2.jsonl", (0.5, {"v": 20}), (4.0, {"v": 1}))
    alone, _ = command.replay("run_1.jsonl").events
    ran = command.replay("run_1.jsonl", "run_2.jsonl")
    assert "2 recordings, 4 samples, 2 episodes started, 2 ended, 2 tasks" in ran.logged
    assert [event["recording"] for event in ran.events] == ["run_1.jsonl"] * 2 + ["run_2.jsonl"] * 2
    assert len({event["id"] for event in ran.events}) == 4
    assert ran.events[0]["id"] == alone["id"]
    tasks = list(yaml.safe_load_all((command.folder / "out" / "tasks.yaml").read_text()))
    assert len({task["metadata"]["name"] for task in tasks}) == len(tasks) == 2
    assert {task["spec"]["requester"]["holder"] for task in tasks} == {"d", "d.2"}
    mixed = command.replay("run_0.jsonl", "run_1.jsonl", "run_2.jsonl", options=["--as-one"])
    assert "recordings" not in mixed.logged


def test_the_files_of_a_numbered_split_are_one_recording(command: CommandLine) -> None:
    command.drive("drive_9.jsonl", *LEFT_OPEN)
    command.drive("drive_10.jsonl", (4.5, {"v": 20}), (5.0, {"v": 1}), (7.0, {"v": 1}))
    for given in (["drive_9.jsonl", "drive_10.jsonl"], ["drive_10.jsonl", "drive_9.jsonl"], ["drive_*.jsonl"], ["."]):
        ran = command.replay(*given)
        assert [event["type"].rpartition(".")[2] for event in ran.events] == ["started", "ended"], given
        assert "recordings" not in ran.logged
    # Numbered alike, but an hour apart: two drives.
    command.drive("drive_10.jsonl", *((time + 3600, {"v": 1}) for time in (0.0, 3.0)))
    ran = command.replay("drive_*.jsonl")
    assert [event["type"].rpartition(".")[2] for event in ran.events] == ["started"]
    assert "2 recordings" in ran.logged


def test_the_files_of_one_rosbag2_folder_are_one_recording(tmp_path: Path) -> None:
    bag = tmp_path / "drive"
    bag.mkdir()
    first, second, other = MESSAGES[:3], MESSAGES[3:], MESSAGES
    for name, messages in (("drive_0.mcap", first), ("late.mcap", second), ("other.mcap", other)):
        write_mcap(bag / name, messages)
    reported = {"rosbag2_bagfile_information": {"relative_file_paths": ["drive_0.mcap", "late.mcap"]}}
    (bag / "metadata.yaml").write_text(yaml.safe_dump(reported))
    files = [bag / "late.mcap", bag / "other.mcap", bag / "drive_0.mcap"]
    assert recordings_of(files) == [(files[2], files[0]), (files[1],)]
    assert recordings_of(files, as_one=True) == [tuple(files)]
    assert recordings_of([bag]) == [(bag,)]


def test_a_split_recording_with_dates_in_its_names_is_one(tmp_path: Path) -> None:
    names = ["run_2026-05-04-10-20-30_0", "run_2026-05-04-10-25-30_1"]
    names += ["cap_00001_20260504102030", "cap_00002_20260504103030"]
    names += ["rosbag2_2023_11_14-22_13_20_0", "rosbag2_2023_11_14-22_13_20_1"]
    for number, name in enumerate(names):
        write_mcap(tmp_path / f"{name}.mcap", [each._replace(time=each.time + 10**9 * number) for each in MESSAGES])
    paths = [tmp_path / f"{name}.mcap" for name in names]
    assert recordings_of(paths) == [tuple(paths[:2]), tuple(paths[2:4]), tuple(paths[4:])]
    assert recordings_of(paths[::-1]) == [tuple(paths[4:]), tuple(paths[2:4]), tuple(paths[:2])]


@pytest.mark.parametrize("date", ["2023_11_14-22_13_2", "2023-11-14-22-13-2", "2023111422132"])
def test_recordings_with_increasing_dates_are_separate(tmp_path: Path, date: str) -> None:
    paths = [tmp_path / f"rosbag2_{date}{number}.mcap" for number in range(2)]
    for number, path in enumerate(paths):
        write_mcap(path, [each._replace(time=each.time + 10**9 * number) for each in MESSAGES])
    assert recordings_of(paths) == [(path,) for path in paths]


def test_splits_of_the_same_name_and_different_dates_are_separate_recordings(tmp_path: Path) -> None:
    paths = [tmp_path / f"run_2026-05-0{day}-10-20-30_{number}.mcap" for day in (4, 5) for number in range(3)]
    for path, seconds in zip(paths, (0, 1, 2, 100, 101, 102), strict=True):
        write_mcap(path, [each._replace(time=each.time + 10**9 * seconds) for each in MESSAGES])
    expected = [tuple(paths[:3]), tuple(paths[3:])]
    assert recordings_of(paths) == expected
    assert recordings_of([paths[number] for number in (1, 4, 0, 5, 2, 3)]) == expected


def test_a_folder_means_all_recordings_in_it(tmp_path: Path) -> None:
    (tmp_path / "day" / ".hidden").mkdir(parents=True)
    bag = write_bag(tmp_path / "day" / "bag", MESSAGES)
    files = [write_mcap(tmp_path / "day" / name, MESSAGES) for name in ("b.mcap", "a2.mcap", "a10.mcap")]
    write_mcap(tmp_path / "day" / ".hidden" / "c.mcap", MESSAGES)
    (tmp_path / "day" / "notes.txt").write_text("a sunny day")
    expected = [(files[1],), (files[2],), (files[0],), (bag,)]
    assert recordings_of([tmp_path]) == expected
    assert recordings_of([tmp_path / "day", files[0]]) == expected
    assert recordings_of([tmp_path / "d*" / "a*.mcap"]) == expected[:2]
    with pytest.raises(RecordingError, match="no file matches: correct the pattern"):
        recordings_of([tmp_path / "*.bag"])
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(RecordingError, match="the folder contains no recording"):
        recordings_of([empty])


def test_a_truncated_recording_is_replayed_with_a_warning_and_a_count(command: CommandLine) -> None:
    path = command.drive("drive.jsonl", (0.5, {"v": 20}), (4.0, {"v": 20}), (6.0, {"v": 1}))
    path.write_bytes(path.read_bytes()[:-10])
    ran = command.replay(path)
    assert (ran.code, len(ran.events)) == (0, 1)
    cut = "drive.jsonl: the recording is cut (line 3 has no end): it contains 2 messages up to there\n"
    assert f"warning: {path.parent}/{cut}" in ran.logged
    checked = command.run("check", "detector.yaml", "rules.yaml", "--recording", str(path))
    assert f"{cut.rstrip()} [cut-recording]" in checked.logged
    command.drive("other.jsonl", (0.5, {"v": 20}))
    assert f"\nwarning: {cut}" in f"\n{command.replay('drive.jsonl', 'other.jsonl').logged}"


def test_rules_are_compared_over_all_recordings(command: CommandLine) -> None:
    command.write(a_detector(a_stream("speed")), a_rule("fast", **FAST), a_rule("faster", **{**FAST, "when": "v > 15"}))
    for name, speed in (("a.jsonl", 20), ("b.jsonl", 12)):
        command.drive(name, (0.5, {"v": speed}), (4.0, {"v": 1}), (6.0, {"v": 1}))
    command.replay("a.jsonl", "b.jsonl", options=["--set", "fast=faster"])
    (comparison,) = json.loads((command.folder / "out" / "variants.json").read_text())
    (both,), (only,) = comparison["both"], comparison["onlyFirst"]
    assert (both["recording"], both["first"]["recording"], only["recording"]) == ("a.jsonl", "a.jsonl", "b.jsonl")
    command.replay("a.jsonl", options=["--set", "fast=faster"])
    assert "recording" not in (command.folder / "out" / "variants.json").read_text()


@pytest.mark.parametrize("place", ["summary", "footer"])
def test_a_numbered_file_with_a_damaged_index_is_an_error_that_names_it(tmp_path: Path, place: str) -> None:
    first, damaged = (write_mcap(tmp_path / f"a_{number}.mcap", MESSAGES) for number in range(2))
    whole = damaged.read_bytes()
    footer = len(whole) - 8 - 20  # before the magic, its three fields
    start = int.from_bytes(whole[footer : footer + 8], "little") if place == "summary" else footer
    damaged.write_bytes(whole[:start] + b"\xff" * 20 + whole[start + 20 :])
    with pytest.raises(RecordingError, match=r"a_1\.mcap: the MCAP file is damaged .*mcap recover .*a_1\.mcap"):
        span_of(damaged)
    assert recordings_of([first, damaged]) == [(first,), (damaged,)]


def test_the_span_of_a_damaged_ros_1_bag_is_an_error_that_names_it(tmp_path: Path) -> None:
    path = tmp_path / "drive_1.bag"
    path.write_bytes(ROSBAG1_MAGIC + (4).to_bytes(4, "little") + b"\xff" * 400)
    with pytest.raises(RecordingError, match=r"drive_1\.bag: .*rosbag reindex"):
        span_of(path)


def test_an_unreadable_recording_is_an_error_and_the_others_are_replayed(command: CommandLine) -> None:
    command.drive("a_0.jsonl", *LEFT_OPEN)
    (command.folder / "a_1.jsonl").write_text('{"t": "now"}\n')
    (command.folder / "empty.mcap").touch()
    command.drive("z.jsonl", *LEFT_OPEN)
    given = ["a_0.jsonl", "a_1.jsonl", "empty.mcap", "z.jsonl"]
    ran = command.replay(*given)
    assert ran.code == 1
    assert [event["recording"] for event in ran.events] == ["a_0.jsonl", "z.jsonl"]
    assert "error: a_1.jsonl:1: " in ran.logged
    assert "error: empty.mcap: the file is empty" in ran.logged
    ran = command.run(
        "check", "detector.yaml", "rules.yaml", *(word for each in given for word in ("--recording", each))
    )
    assert ran.code == 1
    assert "error: empty.mcap: the file is empty" in ran.logged
    assert ran.logged.count(" [unreadable-recording]") == 2
    ran = command.replay("a_1.jsonl", "empty.mcap")
    assert ran.code == 2
    assert "detector: a_1.jsonl:1: " in ran.logged
    assert "detector: empty.mcap: the file is empty" in ran.logged


def test_a_recording_that_does_not_fit_a_stream_is_named(command: CommandLine) -> None:
    command.drive("a.jsonl", *LEFT_OPEN)
    write_mcap(command.folder / "b.mcap", [MESSAGES[0]._replace(key="vehicles/car/speed")])
    ran = command.replay("a.jsonl", "b.mcap")
    assert (ran.code, len(ran.events)) == (1, 1)
    assert "b.mcap: vehicles/car/speed is recorded as cdr, but streams[speed].encoding is json" in ran.logged


def test_a_recording_without_messages_is_named(command: CommandLine) -> None:
    (command.folder / "e.jsonl").touch()
    (command.folder / "tiny8.mcap").write_bytes(write_mcap(command.folder / "whole.mcap", MESSAGES).read_bytes()[:8])
    for name, logged in (
        ("e.jsonl", "e.jsonl contains no message\n"),
        ("tiny8.mcap", "tiny8.mcap contains no message: it is cut (it ends without a footer)\n"),
    ):
        ran = command.replay(name)
        assert (ran.code, ran.logged) == (2, f"detector: {logged}")
    command.drive("a.jsonl", *LEFT_OPEN)
    ran = command.replay("a.jsonl", "e.jsonl")
    assert (ran.code, "e.jsonl: it contains no message" in ran.logged) == (0, True)


def an_intake_file(path: Path) -> None:
    detector, rule = a_detector(a_stream("speed")), a_rule("fast", **FAST)
    path.parent.mkdir(exist_ok=True)
    writer = IntakeWriter(path, detector.spec.streams)
    documents = {"detector": detector.to_json(), "rules": [rule.to_json()]}
    writer.control(at(0), {"kind": "start", "holder": "h", "version": ORDER, **documents})
    writer.arrivals([Arrival(at(time), "speed", "vehicles/car/speed", b'{"v": 20}') for time in (0.5, 4.0)])
    writer.control(at(5), {"kind": "end"})
    writer.close()


def test_an_intake_file_in_a_folder_is_replayed_alone(command: CommandLine) -> None:
    an_intake_file(command.folder / "fold" / "in.mcap")
    for given in ("fold/in.mcap", "fold", "fold/*.mcap"):
        ran = command.run("replay", given, "--output", "out")
        assert (ran.code, [event["source"] for event in ran.events]) == (0, ["/detectors/h"]), ran.logged
        ran = command.run("check", "detector.yaml", "rules.yaml", "--recording", given)
        assert ran.code == 0, ran.logged


def test_an_intake_file_beside_other_recordings_is_refused_by_name(command: CommandLine) -> None:
    an_intake_file(command.folder / "fold" / "in.mcap")
    command.drive("a.jsonl", *LEFT_OPEN)
    command.drive("fold/b.jsonl", *LEFT_OPEN)
    for given in (["a.jsonl", "fold/in.mcap"], ["fold"], ["fold/in.mcap", "a.jsonl"]):
        named = [option for each in given for option in ("--recording", each)]
        for ran in (command.replay(*given), command.run("check", "detector.yaml", "rules.yaml", *named)):
            assert (ran.code, ran.logged) == (2, "detector: fold/in.mcap is an intake file: replay it alone\n")
    assert not (command.folder / "out").exists()
