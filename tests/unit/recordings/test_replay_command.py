"""`detector replay` and `detector check` as a person uses them: files in, lines and an exit code out."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from detector.cli import main
from detector.replay.errors import RecordingError
from detector.replay.gathering import recordings_of
from tests.driving import START, a_detector, a_rule, a_stream, at
from tests.unit.recordings.test_recordings import MESSAGES, write_bag, write_lines, write_mcap


class Ran(NamedTuple):
    code: int
    said: str
    events: list[dict[str, Any]]


class Desk:
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

    def run(self, *arguments: str) -> Ran:
        self._monkeypatch.setattr(sys, "argv", ["detector", *arguments])
        self._monkeypatch.chdir(self.folder)
        with pytest.raises(SystemExit) as left:
            main()
        events = self.folder / "out" / "events.jsonl"
        found = [json.loads(line) for line in events.read_text().splitlines()] if events.exists() else []
        return Ran(int(left.value.code or 0), self._capsys.readouterr().err, found)

    def replay(self, *recordings: str | Path, options: Sequence[str] = ()) -> Ran:
        given = ["--detector", "detector.yaml", "--rules", "rules.yaml", "--output", "out"]
        return self.run("replay", *map(str, recordings), *given, *options)


FAST: dict[str, Any] = {
    "signals": [{"name": "v", "stream": "speed", "value": "msg.v"}],
    "when": "v > 10",
    "until": "v < 5",
}


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Desk:
    return Desk(tmp_path, monkeypatch, capsys)


def times(events: Sequence[dict[str, Any]]) -> list[tuple[str, str | None, str]]:
    return [(e["subject"], e["data"].get("reason"), e["time"]) for e in events]


def test_a_key_may_begin_with_the_slash_of_its_ros_topic(desk: Desk) -> None:
    for key in ("vehicles/${client:*}/speed", "/vehicles/${client:*}/speed"):
        detector = a_detector().to_json()
        detector["spec"]["streams"] = [{"name": "speed", "key": key, "encoding": "json"}]
        desk.write(detector, a_rule("fast", **FAST))
        desk.drive("drive.jsonl", (0.5, {"v": 20}), (3.5, {"v": 1}), (5.0, {"v": 1}), key="/vehicles/car/speed")
        assert desk.run("check", "detector.yaml", "rules.yaml").code == 0
        ran = desk.replay("drive.jsonl")
        assert (ran.code, len(ran.events)) == (0, 2), ran.said


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("odom/", ["spec.streams[0].key", "'odom/'", "column 6", "the key ends with a slash: remove it"]),
        ("a//b", ["spec.streams[0].key", "'a//b'", "column 3", "two slashes stand in a row: remove one"]),
        ("//${client:*}/odom", ["'//${client:*}/odom'", "column 2", "two slashes stand in a row: remove one"]),
        ("/", ["'/'", "it is empty: give a key such as"]),
        ("v/${client}/x", ["key", "write ${client:*}"]),
    ],
)
def test_a_key_that_is_none_is_explained_by_replay_as_by_check(desk: Desk, key: str, words: list[str]) -> None:
    detector = a_detector().to_json()
    client = {} if "client" in key else {"client": "ego"}
    detector["spec"]["streams"] = [{"name": "odom", "key": key, "encoding": "json", **client}]
    desk.write(detector, a_rule("fast", **FAST))
    desk.drive("drive.jsonl", (0.5, {"v": 20}))
    for ran in (desk.replay("drive.jsonl"), desk.run("check", "detector.yaml")):
        assert ran.code != 0
        assert "Traceback" not in ran.said
        for word in words:
            assert word in ran.said


def test_an_error_of_a_value_names_client_and_stream_and_what_was_there(desk: Desk) -> None:
    signal = {"name": "x", "stream": "speed", "value": "msg.v.x"}
    desk.write(a_detector(a_stream("speed")), a_rule("r", signals=[signal], when="x > 1"))
    ran = desk.replay(desk.drive("drive.jsonl", (0.5, {"v": 3}), (2.0, {"v": {"x": 3}})))
    assert (
        "evaluation errors in EventRule r; the last: signal x of car, stream speed: "
        "`msg.v` is 3.0, which has no field `x`: correct the path" in ran.said
    )


def test_a_stamp_that_reads_a_member_of_a_number_is_explained(desk: Desk) -> None:
    desk.write(a_detector(a_stream("speed", stamp="msg.v.t"), clock="Data"), a_rule("r", **FAST))
    ran = desk.replay(desk.drive("drive.jsonl", (0.5, {"v": 3})))
    assert "the last: vehicles/car/speed: `msg.v` is 3.0, which has no field `t`: correct the path" in ran.said


def test_an_error_of_a_parameter_names_the_client(desk: Desk) -> None:
    deploy = {"name": "go", "deploy": {"template": "app", "parameters": {"vehicle": "${v.q}"}}}
    desk.write(a_detector(a_stream("speed")), a_rule("r", **FAST, actions=[deploy]))
    ran = desk.replay(desk.drive("drive.jsonl", (0.5, {"v": 30}), (2.0, {"v": 30})))
    assert "action go of car: vehicle, line 1, column 3: `v.q`: `v` is 30.0, which has no field `q`" in ran.said


def test_an_error_of_a_fleet_condition_names_the_signals_that_it_reads(desk: Desk) -> None:
    desk.write(
        a_detector(a_stream("speed")),
        a_rule("r", scope={"fleet": {"members": "true"}}, signals=FAST["signals"], when="members.exists(c, c.v > 10)"),
    )
    ran = desk.replay(desk.drive("drive.jsonl", (0.5, {"v": "fast"}), (2.0, {"v": "fast"})))
    assert "the last: when of ~fleet (v of stream speed): `>` compares a text with a number" in ran.said


@pytest.mark.parametrize(
    ("field", "text", "said"),
    [
        ("key", "veh/${client:*}/odom/", "detector.yaml:29:10: spec.streams[0].key: "),
        ("stamp", "msg.", "detector.yaml:31:12: spec.streams[0].stamp: line 1, "),
        ("stamp", "t", "; write sample.received for the t of JSON lines"),
    ],
)
def test_what_is_wrong_with_a_stream_has_file_line_and_column_in_replay_as_in_check(
    desk: Desk, field: str, text: str, said: str
) -> None:
    detector = a_detector().to_json()
    stream = {"name": "odom", "key": "veh/${client:*}/odom", "encoding": "json", field: text}
    detector["spec"]["streams"] = [stream]
    desk.write(detector, a_rule("fast", **FAST))
    desk.drive("drive.jsonl", (0.5, {"v": 20}))
    checked = desk.run("check", "detector.yaml").said
    assert said in checked
    assert checked in desk.replay("drive.jsonl").said


def test_an_error_of_a_condition_names_client_and_stream(desk: Desk) -> None:
    desk.write(a_detector(a_stream("speed")), a_rule("r", **{**FAST, "when": "v > 10", "until": "v.low"}))
    ran = desk.replay(desk.drive("drive.jsonl", (0.5, {"v": 30}), (3.0, {"v": 30})))
    assert "the last: until of car (v of stream speed): `v` is 30.0, which has no field `low`" in ran.said


def test_samples_that_name_no_client_are_counted_with_a_key(desk: Desk) -> None:
    path = desk.drive("drive.jsonl", (0.5, {"v": 3}), (2.0, {"v": 3}), key="vehicles/no name/speed")
    said = "2 samples of stream speed dropped, naming no client by key or message; the last: the key vehicles/no name/"
    assert said in desk.replay(path).said


def test_what_a_client_can_never_have_is_not_counted_as_unknown(desk: Desk) -> None:
    """A station sends its own stream alone; vehicles send speeds, under names that begin with v."""
    station = {"name": "station", "key": "station/state", "client": "rsu", "encoding": "json"}
    speed = {"name": "speed", "key": "vehicles/${client:v$*}/speed", "encoding": "json"}
    near = {"pairs": {"position": {"stream": "speed", "x": "msg.v", "y": "0.0"}, "within": 1}}
    desk.write(
        a_detector(station, speed),
        a_rule("fast", **FAST),
        a_rule("near", scope=near, when="distance < 1"),
    )
    lines = [{"t": at(time / 2), "key": "vehicles/v1/speed", "value": {"v": 3}} for time in range(1, 9)]
    lines += [{"t": at(time / 2), "key": "station/state", "value": {}} for time in range(1, 9)]
    ran = desk.replay(write_lines(desk.folder / "drive.jsonl", *sorted(lines, key=lambda line: str(line["t"]))))
    assert "unknown values" not in ran.said
    lines[3]["value"] = {}
    ran = desk.replay(write_lines(desk.folder / "drive.jsonl", *sorted(lines, key=lambda line: str(line["t"]))))
    assert "unknown values in " in ran.said
    assert "EventRule fast" in ran.said


def stamped(stream: str, delay: float, count: int = 40, **fields: Any) -> list[dict[str, Any]]:
    """A sample every tenth of a second, stamped so many seconds before it was recorded."""
    return [
        {
            "t": at(time / 10),
            "key": f"vehicles/car/{stream}",
            "value": {"time": (at(time / 10) - delay * 1e9) / 1e9, **fields},
        }
        for time in range(count)
    ]


def recorded(*streams: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted((line for stream in streams for line in stream), key=lambda line: int(line["t"]))


def test_with_clock_data_a_stream_without_stamps_is_named(desk: Desk) -> None:
    without = a_detector(a_stream("pose", stamp="msg.time"), a_stream("speed"), clock="Data")
    desk.write(without, a_rule("fast", **FAST))
    path = write_lines(desk.folder / "drive.jsonl", *recorded(stamped("pose", 0), stamped("speed", 0, v=1)))
    ran = desk.replay(path)
    assert "40 samples of stream speed carry no stamp, those of other streams do" in ran.said
    assert "streams[speed].stamp" in ran.said
    ran = desk.run("check", "--strict", "detector.yaml", "rules.yaml")
    assert (ran.code, "spec.streams[1]: stream speed carries no stamp, and others do" in ran.said) == (1, True)
    with_stamps = a_detector(a_stream("pose", stamp="msg.time"), a_stream("speed", stamp="msg.time"), clock="Data")
    desk.write(with_stamps, a_rule("fast", **FAST))
    assert "stamp" not in desk.replay(path).said
    assert desk.run("check", "--strict", "detector.yaml", "rules.yaml").code == 0


def test_with_clock_data_a_header_that_is_seconds_behind_is_named_with_its_stream(desk: Desk) -> None:
    streams = [a_stream(name, stamp="msg.time") for name in ("pose", "speed")]
    desk.write(a_detector(*streams, clock="Data"), a_rule("fast", **FAST))
    recording = recorded(stamped("pose", 0.1), stamped("speed", 5.2, v=1))
    path = write_lines(desk.folder / "drive.jsonl", *recording)
    warning = (
        "warning: stamps of stream speed are 5.1 s further behind the receive times than those of stream pose: with "
        "clock Data its samples are late for the others; set the sender's clock, give streams[speed].stamp"
    )
    assert warning in desk.replay(path).said
    ran = desk.run("check", "--strict", "detector.yaml", "rules.yaml", "--recording", str(path))
    assert (ran.code, warning in ran.said) == (1, True)


def test_with_clock_data_a_stream_whose_stamps_are_ahead_of_its_receipt_is_named_and_no_other(desk: Desk) -> None:
    streams = [a_stream(name, stamp="msg.time") for name in ("pose", "speed")]
    desk.write(a_detector(*streams, clock="Data"), a_rule("fast", **FAST))
    recording = recorded(stamped("pose", 0.1), stamped("speed", -5, v=1))
    ran = desk.replay(write_lines(desk.folder / "drive.jsonl", *recording))
    assert "warning: stamps of stream speed are 5.0 s ahead of the receive times: " in ran.said
    assert "stamps of stream pose" not in ran.said


def test_with_clock_data_stamps_of_0_are_named_as_such(desk: Desk) -> None:
    streams = [a_stream(name, stamp="msg.time") for name in ("pose", "speed")]
    desk.write(a_detector(*streams, clock="Data"), a_rule("fast", **FAST))
    unfilled = [{**line, "value": {"time": 0, "v": 1}} for line in stamped("speed", 0)]
    ran = desk.replay(write_lines(desk.folder / "drive.jsonl", *recorded(stamped("pose", 0), unfilled)))
    assert "warning: 40 samples of stream speed are without a time: their stamps are 0; " in ran.said
    assert "behind the receive times" not in ran.said


def test_the_stamps_of_a_simulation_may_all_be_years_behind(desk: Desk) -> None:
    streams = [a_stream(name, stamp="msg.time") for name in ("pose", "speed")]
    desk.write(a_detector(*streams, clock="Data"), a_rule("fast", **FAST))
    recording = recorded(stamped("pose", START / 1e9), stamped("speed", START / 1e9, v=1))
    ran = desk.replay(write_lines(desk.folder / "drive.jsonl", *recording))
    assert "behind" not in ran.said


def test_the_t_of_json_lines_can_be_the_stamp(desk: Desk) -> None:
    streams = [a_stream("pose", stamp="msg.time"), a_stream("speed", stamp="sample.received")]
    latency = {"name": "late", "stream": "speed", "value": "sample.latency"}
    desk.write(a_detector(*streams, clock="Data"), a_rule("r", signals=[latency], when="late == 0"))
    recording = recorded(stamped("pose", 0), [{**line, "t": line["t"] + 1} for line in stamped("speed", 0, v=1)])
    ran = desk.replay(write_lines(desk.folder / "drive.jsonl", *recording))
    assert (ran.code, len(ran.events)) == (0, 1)
    assert "stamp" not in ran.said


def test_that_no_message_belongs_to_a_stream_is_an_error_with_both_keys(desk: Desk) -> None:
    path = desk.drive("drive.jsonl", (0.5, {"v": 3}), key="veh/car/speed")
    ran = desk.replay(path)
    assert ran.code == 2
    assert "the recordings hold the keys veh/car/speed, the streams ask for vehicles/${client:*}/speed" in ran.said
    assert not (desk.folder / "out").exists()
    other = desk.drive("other.jsonl", (0.5, {"v": 3}), (2.0, {"v": 3}))
    ran = desk.replay(path, other)
    assert ran.code == 0
    assert "drive.jsonl: no message belongs to a stream of the Detector; keys: veh/car/speed" in ran.said


LEFT_OPEN = [(0.5, {"v": 20}), (4.0, {"v": 20})]
YEAR = 365 * 24 * 3600.0


def test_several_recordings_are_independent_of_each_other(desk: Desk) -> None:
    """An episode that is open at the end of the first does not go on in the second, a year later."""
    desk.drive("a.jsonl", *LEFT_OPEN)
    desk.drive("b.jsonl", *((YEAR + time, {"v": 4}) for time in (0.0, 2.0, 4.0)))
    alone = desk.replay("a.jsonl").events + desk.replay("b.jsonl").events
    assert [event["type"] for event in alone] == ["dev.wayside.event.started"]
    assert desk.replay("a.jsonl", "b.jsonl").events == alone
    assert desk.replay("b.jsonl", "a.jsonl").events == alone
    as_one = desk.replay("a.jsonl", "b.jsonl", options=["--as-one"]).events
    assert [event["type"] for event in as_one] == ["dev.wayside.event.started", "dev.wayside.event.ended"]


def test_simulated_recordings_that_all_begin_at_the_same_time_do_not_mix(desk: Desk) -> None:
    for run in range(3):
        desk.drive(f"run_{run}.jsonl", (0.5, {"v": 20 if run == 1 else 1}), (4.0, {"v": 1}))
    ran = desk.replay("run_0.jsonl", "run_1.jsonl", "run_2.jsonl")
    assert "3 recordings, 6 samples, 1 episodes started, 1 ended" in ran.said
    mixed = desk.replay("run_0.jsonl", "run_1.jsonl", "run_2.jsonl", options=["--as-one"])
    assert "recordings" not in mixed.said


def test_the_files_of_a_numbered_split_are_one_recording(desk: Desk) -> None:
    desk.drive("drive_9.jsonl", *LEFT_OPEN)
    desk.drive("drive_10.jsonl", (4.5, {"v": 20}), (5.0, {"v": 1}), (7.0, {"v": 1}))
    for given in (["drive_9.jsonl", "drive_10.jsonl"], ["drive_*.jsonl"], ["."]):
        ran = desk.replay(*given)
        assert [event["type"].rpartition(".")[2] for event in ran.events] == ["started", "ended"], given
        assert "recordings" not in ran.said
    # Numbered alike, but an hour apart: two drives.
    desk.drive("drive_10.jsonl", *((time + 3600, {"v": 1}) for time in (0.0, 3.0)))
    ran = desk.replay("drive_*.jsonl")
    assert [event["type"].rpartition(".")[2] for event in ran.events] == ["started"]
    assert "2 recordings" in ran.said


def test_the_files_of_one_rosbag2_folder_are_one_recording(tmp_path: Path) -> None:
    bag = tmp_path / "drive"
    bag.mkdir()
    first, second, other = MESSAGES[:3], MESSAGES[3:], MESSAGES
    for name, messages in (("drive_0.mcap", first), ("late.mcap", second), ("other.mcap", other)):
        write_mcap(bag / name, messages)
    told = {"rosbag2_bagfile_information": {"relative_file_paths": ["drive_0.mcap", "late.mcap"]}}
    (bag / "metadata.yaml").write_text(yaml.safe_dump(told))
    files = [bag / "late.mcap", bag / "other.mcap", bag / "drive_0.mcap"]
    assert recordings_of(files) == [(files[2], files[0]), (files[1],)]
    assert recordings_of(files, as_one=True) == [tuple(files)]
    assert recordings_of([bag]) == [(bag,)]


def test_a_split_recording_with_dates_in_its_names_is_one(tmp_path: Path) -> None:
    names = ["run_2026-05-04-10-20-30_0", "run_2026-05-04-10-25-30_1"]
    names += ["cap_00001_20260504102030", "cap_00002_20260504103030"]
    for number, name in enumerate(names):
        write_mcap(tmp_path / f"{name}.mcap", [each._replace(time=each.time + 10**9 * number) for each in MESSAGES])
    paths = [tmp_path / f"{name}.mcap" for name in names]
    assert recordings_of(paths) == [tuple(paths[:2]), tuple(paths[2:])]


def test_a_folder_stands_for_the_recordings_in_it(tmp_path: Path) -> None:
    (tmp_path / "day" / ".hidden").mkdir(parents=True)
    bag = write_bag(tmp_path / "day" / "bag", MESSAGES)
    files = [write_mcap(tmp_path / "day" / name, MESSAGES) for name in ("b.mcap", "a2.mcap", "a10.mcap")]
    write_mcap(tmp_path / "day" / ".hidden" / "c.mcap", MESSAGES)
    (tmp_path / "day" / "notes.txt").write_text("a sunny day")
    expected = [(files[1],), (files[2],), (files[0],), (bag,)]
    assert recordings_of([tmp_path]) == expected
    assert recordings_of([tmp_path / "day", files[0]]) == expected
    assert recordings_of([tmp_path / "d*" / "a*.mcap"]) == expected[:2]
    with pytest.raises(RecordingError, match="nothing matches: correct the pattern"):
        recordings_of([tmp_path / "*.bag"])
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(RecordingError, match="the folder holds no recording"):
        recordings_of([empty])


def test_a_cut_recording_is_replayed_with_a_warning_and_a_count(desk: Desk) -> None:
    path = desk.drive("drive.jsonl", (0.5, {"v": 20}), (4.0, {"v": 20}), (6.0, {"v": 1}))
    path.write_bytes(path.read_bytes()[:-10])
    ran = desk.replay(path)
    assert (ran.code, len(ran.events)) == (0, 1)
    assert "warning: " in ran.said
    assert "drive.jsonl: the recording is cut (line 3 has no end): 2 messages are read up to there" in ran.said


def test_rules_are_compared_over_all_recordings(desk: Desk) -> None:
    desk.write(a_detector(a_stream("speed")), a_rule("fast", **FAST), a_rule("faster", **{**FAST, "when": "v > 15"}))
    for name, speed in (("a.jsonl", 20), ("b.jsonl", 12)):
        desk.drive(name, (0.5, {"v": speed}), (4.0, {"v": 1}), (6.0, {"v": 1}))
    ran = desk.replay("a.jsonl", "b.jsonl", options=["--compare", "fast", "faster"])
    assert "fast and faster: 1 episodes in both, 1 only in fast, 0 only in faster" in ran.said
