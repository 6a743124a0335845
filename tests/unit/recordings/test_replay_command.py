"""`detector replay` and `detector check` as a person uses them: files in, lines and an exit code out."""

from __future__ import annotations

from typing import Any

import pytest

from detector.findings.checks import CHECKS
from tests.driving import START, a_detector, a_rule, a_stream, at
from tests.unit.recordings.command_line import FAST, CommandLine
from tests.unit.recordings.test_recordings import write_lines
from wayside.findings import Severity


def test_a_key_may_begin_with_the_slash_of_its_ros_topic(command: CommandLine) -> None:
    for key in ("vehicles/${client:*}/speed", "/vehicles/${client:*}/speed"):
        detector = a_detector().to_json()
        detector["spec"]["streams"] = [{"name": "speed", "key": key, "encoding": "json"}]
        command.write(detector, a_rule("fast", **FAST))
        command.drive("drive.jsonl", (0.5, {"v": 20}), (3.5, {"v": 1}), (5.0, {"v": 1}), key="/vehicles/car/speed")
        assert command.run("check", "detector.yaml", "rules.yaml").code == 0
        ran = command.replay("drive.jsonl")
        assert (ran.code, len(ran.events)) == (0, 2), ran.logged


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("odom/", ["spec.streams[0].key", "'odom/'", "column 6", "the key ends with a slash: remove it"]),
        ("a//b", ["spec.streams[0].key", "'a//b'", "column 3", "the pattern has two slashes in a row: remove one"]),
        (
            "//${client:*}/odom",
            ["'//${client:*}/odom'", "column 2", "two slashes in a row: remove one"],
        ),
        ("/", ["'/'", "it is empty: give a key such as"]),
        ("v/${client}/x", ["key", "write ${client:*}"]),
    ],
)
def test_an_invalid_key_is_explained_by_replay_as_by_check(command: CommandLine, key: str, words: list[str]) -> None:
    detector = a_detector().to_json()
    client = {} if "client" in key else {"client": "ego"}
    detector["spec"]["streams"] = [{"name": "odom", "key": key, "encoding": "json", **client}]
    command.write(detector, a_rule("fast", **FAST))
    command.drive("drive.jsonl", (0.5, {"v": 20}))
    for ran in (command.replay("drive.jsonl"), command.run("check", "detector.yaml")):
        assert ran.code != 0
        assert "Traceback" not in ran.logged
        for word in words:
            assert word in ran.logged


def test_an_error_of_a_value_names_client_stream_and_value(command: CommandLine) -> None:
    signal = {"name": "x", "stream": "speed", "value": "msg.v.x"}
    command.write(a_detector(a_stream("speed")), a_rule("r", signals=[signal], when="x > 1"))
    ran = command.replay(command.drive("drive.jsonl", (0.5, {"v": 3}), (2.0, {"v": {"x": 3}})))
    assert (
        "evaluation errors in EventRule r; the last: signal x of car, stream speed: "
        "`msg.v` is 3.0, which has no field `x`: correct the path" in ran.logged
    )


def test_a_stamp_that_reads_a_member_of_a_number_is_explained(command: CommandLine) -> None:
    command.write(a_detector(a_stream("speed", stamp="msg.v.t"), clock="Data"), a_rule("r", **FAST))
    ran = command.replay(command.drive("drive.jsonl", (0.5, {"v": 3})))
    assert "the last: vehicles/car/speed: `msg.v` is 3.0, which has no field `t`: correct the path" in ran.logged


def test_an_error_of_a_parameter_names_the_client(command: CommandLine) -> None:
    deploy = {"name": "go", "deploy": {"templateName": "app", "parameters": {"vehicle": "${v.q}"}}}
    command.write(a_detector(a_stream("speed")), a_rule("r", **FAST, actions=[deploy]))
    ran = command.replay(command.drive("drive.jsonl", (0.5, {"v": 30}), (2.0, {"v": 30})))
    assert "action go of car: vehicle, line 1, column 3: `v.q`: `v` is 30.0, which has no field `q`" in ran.logged


def test_an_error_of_a_fleet_condition_names_the_signals_that_it_reads(command: CommandLine) -> None:
    command.write(
        a_detector(a_stream("speed")),
        a_rule("r", scope={"fleet": {"members": "true"}}, signals=FAST["signals"], when="members.exists(c, c.v > 10)"),
    )
    ran = command.replay(command.drive("drive.jsonl", (0.5, {"v": "fast"}), (2.0, {"v": "fast"})))
    assert "the last: when of ~fleet (v of stream speed): `>` cannot compare a string with a number" in ran.logged


@pytest.mark.parametrize(
    ("field", "text", "logged"),
    [
        ("key", "veh/${client:*}/odom/", ":10: spec.streams[0].key: "),
        ("stamp", "msg.", ":12: spec.streams[0].stamp: line 1, "),
        ("stamp", "t", "; for the field t of JSON lines, write sample.received"),
    ],
)
def test_errors_of_a_stream_have_file_line_and_column_in_replay_as_in_check(
    command: CommandLine, field: str, text: str, logged: str
) -> None:
    detector = a_detector().to_json()
    stream = {"name": "odom", "key": "veh/${client:*}/odom", "encoding": "json", field: text}
    detector["spec"]["streams"] = [stream]
    command.write(detector, a_rule("fast", **FAST))
    command.drive("drive.jsonl", (0.5, {"v": 20}))
    lines = (command.folder / "detector.yaml").read_text().splitlines()
    (place,) = (number for number, line in enumerate(lines, 1) if line.lstrip(" -").startswith(f"{field}: {text}"))
    checked = command.run("check", "detector.yaml").logged.removesuffix(" [invalid-detector]\n")
    assert f"detector.yaml:{place}:" in checked
    assert logged in checked
    assert checked in command.replay("drive.jsonl").logged


def test_an_error_of_a_condition_names_client_and_stream(command: CommandLine) -> None:
    command.write(a_detector(a_stream("speed")), a_rule("r", **{**FAST, "when": "v > 10", "until": "v.low"}))
    ran = command.replay(command.drive("drive.jsonl", (0.5, {"v": 30}), (3.0, {"v": 30})))
    assert "the last: until of car (v of stream speed): `v` is 30.0, which has no field `low`" in ran.logged


def test_samples_without_a_client_are_counted_with_a_key(command: CommandLine) -> None:
    path = command.drive("drive.jsonl", (0.5, {"v": 3}), (2.0, {"v": 3}), key="vehicles/no name/speed")
    logged = "2 samples of stream speed dropped because neither key nor message names a client; the last: vehicles/"
    assert logged in command.replay(path).logged


def test_signals_of_streams_a_client_never_sends_are_not_counted_as_unknown(command: CommandLine) -> None:
    """A station sends its own stream alone; vehicles send speeds, under names that begin with v."""
    station = {"name": "station", "key": "station/state", "client": "rsu", "encoding": "json"}
    speed = {"name": "speed", "key": "vehicles/${client:v$*}/speed", "encoding": "json"}
    near = {"pairs": {"position": {"stream": "speed", "x": "msg.v", "y": "0.0"}, "within": 1}}
    command.write(
        a_detector(station, speed),
        a_rule("fast", **FAST),
        a_rule("near", scope=near, when="distance < 1"),
    )
    lines = [{"t": at(time / 2), "key": "vehicles/v1/speed", "value": {"v": 3}} for time in range(1, 9)]
    lines += [{"t": at(time / 2), "key": "station/state", "value": {}} for time in range(1, 9)]
    ran = command.replay(write_lines(command.folder / "drive.jsonl", *sorted(lines, key=lambda line: str(line["t"]))))
    assert "unknown values" not in ran.logged
    lines[3]["value"] = {}
    ran = command.replay(write_lines(command.folder / "drive.jsonl", *sorted(lines, key=lambda line: str(line["t"]))))
    assert "unknown values in " in ran.logged
    assert "EventRule fast" in ran.logged


def stamped(stream: str, delay: float, count: int = 40, **fields: Any) -> list[dict[str, Any]]:
    """A sample every tenth of a second, recorded `delay` seconds after its stamp."""
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


def test_with_clock_data_a_stream_without_stamps_is_named(command: CommandLine) -> None:
    without = a_detector(a_stream("pose", stamp="msg.time"), a_stream("speed"), clock="Data")
    command.write(without, a_rule("fast", **FAST))
    path = write_lines(command.folder / "drive.jsonl", *recorded(stamped("pose", 0), stamped("speed", 0, v=1)))
    ran = command.replay(path)
    assert "40 samples of stream speed have no stamp, unlike those of other streams" in ran.logged
    assert "streams[speed].stamp" in ran.logged
    ran = command.run("check", "--strict", "detector.yaml", "rules.yaml")
    assert (ran.code, "spec.streams[1]: stream speed has no stamp, unlike others" in ran.logged) == (1, True)
    with_stamps = a_detector(a_stream("pose", stamp="msg.time"), a_stream("speed", stamp="msg.time"), clock="Data")
    command.write(with_stamps, a_rule("fast", **FAST))
    assert "stamp" not in command.replay(path).logged
    assert command.run("check", "--strict", "detector.yaml", "rules.yaml").code == 0


def test_with_clock_data_a_header_that_is_seconds_behind_is_named_with_its_stream(command: CommandLine) -> None:
    streams = [a_stream(name, stamp="msg.time") for name in ("pose", "speed")]
    command.write(a_detector(*streams, clock="Data"), a_rule("fast", **FAST))
    recording = recorded(stamped("pose", 0.1), stamped("speed", 5.2, v=1))
    path = write_lines(command.folder / "drive.jsonl", *recording)
    warning = (
        "warning: the stamps of stream speed are 5.1 s further behind the receive times than those of stream pose: "
        "with clock Data this makes its samples late; synchronize the sender's clock, give streams[speed].stamp"
    )
    assert warning in command.replay(path).logged
    ran = command.run("check", "--strict", "detector.yaml", "rules.yaml", "--recording", str(path))
    assert (ran.code, warning in ran.logged) == (1, True)
    assert " [diverging-stamps]" in ran.logged


def test_with_clock_data_a_stream_whose_stamps_are_ahead_of_its_receipt_is_named_and_no_other(
    command: CommandLine,
) -> None:
    streams = [a_stream(name, stamp="msg.time") for name in ("pose", "speed")]
    command.write(a_detector(*streams, clock="Data"), a_rule("fast", **FAST))
    recording = recorded(stamped("pose", 0.1), stamped("speed", -5, v=1))
    ran = command.replay(write_lines(command.folder / "drive.jsonl", *recording))
    assert "warning: the stamps of stream speed are 5.0 s ahead of the receive times: " in ran.logged
    assert "stamps of stream pose" not in ran.logged


def test_with_clock_data_stamps_of_0_are_named_as_such(command: CommandLine) -> None:
    streams = [a_stream(name, stamp="msg.time") for name in ("pose", "speed")]
    command.write(a_detector(*streams, clock="Data"), a_rule("fast", **FAST))
    unfilled = [{**line, "value": {"time": 0, "v": 1}} for line in stamped("speed", 0)]
    path = write_lines(command.folder / "drive.jsonl", *recorded(stamped("pose", 0), unfilled))
    checked = command.run("check", "detector.yaml", "rules.yaml", "--recording", str(path))
    assert " [zero-stamps]" in checked.logged
    ran = command.replay(path)
    assert "warning: 40 samples of stream speed have no time: their stamps are 0; " in ran.logged
    assert "behind the receive times" not in ran.logged


def test_the_stamps_of_a_simulation_may_all_be_years_behind(command: CommandLine) -> None:
    streams = [a_stream(name, stamp="msg.time") for name in ("pose", "speed")]
    command.write(a_detector(*streams, clock="Data"), a_rule("fast", **FAST))
    recording = recorded(stamped("pose", START / 1e9), stamped("speed", START / 1e9, v=1))
    ran = command.replay(write_lines(command.folder / "drive.jsonl", *recording))
    assert "behind" not in ran.logged


def test_the_t_of_json_lines_can_be_the_stamp(command: CommandLine) -> None:
    streams = [a_stream("pose", stamp="msg.time"), a_stream("speed", stamp="sample.received")]
    latency = {"name": "late", "stream": "speed", "value": "sample.latency"}
    command.write(a_detector(*streams, clock="Data"), a_rule("r", signals=[latency], when="late == 0"))
    recording = recorded(stamped("pose", 0), [{**line, "t": line["t"] + 1} for line in stamped("speed", 0, v=1)])
    ran = command.replay(write_lines(command.folder / "drive.jsonl", *recording))
    assert (ran.code, len(ran.events)) == (0, 1)
    assert "stamp" not in ran.logged


def test_a_recording_without_messages_of_any_stream_is_an_error_with_both_keys(command: CommandLine) -> None:
    path = command.drive("drive.jsonl", (0.5, {"v": 3}), key="veh/car/speed")
    ran = command.replay(path)
    assert ran.code == 2
    assert "the recordings have the keys veh/car/speed, the streams request vehicles/${client:*}/speed" in ran.logged
    assert not (command.folder / "out").exists()
    other = command.drive("other.jsonl", (0.5, {"v": 3}), (2.0, {"v": 3}))
    ran = command.replay(path, other)
    assert ran.code == 0
    assert "drive.jsonl: no message belongs to a stream of the Detector; keys: veh/car/speed" in ran.logged


CLASSIFIED = {**FAST, "classification": {"incidence": ["Rare"]}, "when": "true"}
STAMPED = a_detector(a_stream("pose", stamp="msg.time"), a_stream("speed"), clock="Data")
IGNORING = {"wayside.dev/ignore-findings": "classification-incidence, old-samples"}


@pytest.mark.parametrize(
    ("objects", "name"),
    [
        ([{**a_detector().to_json(), "spec": 5}], "unreadable-file"),
        ([a_detector(a_stream("speed", encoding="cdr", type="nobody/msg/Nothing"))], "invalid-detector"),
        ([a_detector(a_stream("speed")), a_rule("r", when="v > 1")], "invalid-rule"),
        ([a_rule("r", **FAST)], "missing-detector"),
        (
            [a_detector(a_stream("speed"), ruleSelector={"matchLabels": {"a": "b"}}), a_rule("r", **FAST)],
            "rule-not-selected",
        ),
        (
            [
                a_detector(a_stream("speed"), clients=[{"name": "car", "parameters": {"fats": {"limit": 1}}}]),
                a_rule("fast", **FAST),
            ],
            "unknown-rule",
        ),
        ([STAMPED, a_rule("fast", **FAST)], "stream-without-stamps"),
        ([a_detector(a_stream("speed")), a_rule("r", **CLASSIFIED)], "classification-incidence"),
    ],
)
def test_a_finding_of_check_ends_with_its_name_and_only_errors_fail(
    command: CommandLine, objects: list[Any], name: str
) -> None:
    command.write(*objects)
    ran = command.run("check", "detector.yaml", "rules.yaml")
    severity = {each.name: each.severity for each in CHECKS}[name]
    [line] = [line for line in ran.logged.splitlines() if line.endswith(f" [{name}]")]
    assert (": warning: " in line, ran.code) == ((True, 0) if severity is Severity.WARNING else (False, 1)), line


def test_warnings_are_ignored_by_option_and_by_annotation_and_errors_never(command: CommandLine) -> None:
    rule = a_rule("r", **CLASSIFIED).to_json()
    command.write(a_detector(a_stream("speed"), a_stream("unused")), rule)
    recording = command.drive("drive.jsonl", (0.5, {"v": 20}))
    strict = ("check", "--strict", "detector.yaml", "rules.yaml", "--recording", str(recording))
    assert command.run(*strict).logged.count(" [") == 2
    unmatched = command.run(*strict, "--ignore", "classification-incidence")
    assert (unmatched.code, unmatched.logged.count(" ["), "[unmatched-stream]" in unmatched.logged) == (1, 1, True)
    rule["metadata"]["annotations"] = IGNORING
    command.write(a_detector(a_stream("speed"), a_stream("unused")), rule)
    assert command.run(*strict).logged == unmatched.logged
    both = command.run(*strict, "--ignore", "unmatched-stream")
    assert (both.code, both.logged) == (0, "1 Detector, 1 EventRule: no errors\n")
    misspelt = command.run("check", "detector.yaml", "--ignore", "old-sample")
    assert (misspelt.code, "there is no such finding; did you mean old-samples?" in misspelt.logged) == (2, True)
    error = command.run("check", "detector.yaml", "--ignore", "invalid-rule")
    assert (error.code, "only warnings can be ignored" in error.logged) == (2, True)
