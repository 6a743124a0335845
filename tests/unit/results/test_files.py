"""The files of results, read back by other libraries: all have the same numbers."""

from __future__ import annotations

import base64
import csv
import gzip
import json
import re
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from detector.commands.replay import replay_files
from detector.engine.timing.steps import ORDER
from detector.replay.intake_writer import IntakeWriter
from detector.results import kinds
from detector.results.channels import message_path
from detector.results.episodes import TIMES
from detector.results.kinds import ResultKind, chosen
from tests.unit.results.drives import SECOND, START, arrivals, documents, write
from wayside.times import format_time, parse_time

ALL = chosen([ResultKind.ALL])
HAIR = 1e-6


class Results(NamedTuple):
    folder: Path
    report: dict[str, Any]
    messages: dict[str, list[tuple[int, Any]]]
    """Of the MCAP file, by topic."""
    schemas: dict[str, dict[str, Any]]
    rows: list[dict[str, Any]]
    """Of the Parquet file."""
    events: list[dict[str, Any]]


def report_data(page: str) -> dict[str, Any]:
    packed = re.search(r'<script type="text/plain" id="data">([^<]+)</script>', page)
    assert packed is not None
    data: dict[str, Any] = json.loads(gzip.decompress(base64.b64decode(packed[1])))
    return data


def table_of(path: Path) -> list[dict[str, Any]]:
    """The rows; times in nanoseconds since the epoch."""
    table = pq.read_table(path)
    for place, column in enumerate(table.schema):
        if column.name in TIMES:
            assert str(column.type) == "timestamp[ns, tz=UTC]"
            table = table.set_column(place, column.name, table.column(place).cast("int64"))
    rows: list[dict[str, Any]] = table.to_pylist()
    return rows


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    folder = tmp_path_factory.mktemp("results")
    recording, detector, rules = write(folder)
    replay_files([recording], folder / "out", detector, [rules], as_one=False, kinds=ALL)
    messages: dict[str, list[tuple[int, Any]]] = {}
    schemas = {}
    with (folder / "out/results.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            if channel.message_encoding == "json":
                schemas[channel.topic] = json.loads(schema.data)
                messages.setdefault(channel.topic, []).append((message.log_time, json.loads(message.data)))
        file.seek(0)
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages(topics=["/wayside/scene", "/wayside/log"]):
            messages.setdefault(channel.topic, []).append((message.log_time, decoded))
    events = [json.loads(line) for line in (folder / "out/events.jsonl").read_text().splitlines()]
    page = (folder / "out/report.html").read_text()
    rows = table_of(folder / "out/episodes.parquet")
    return Results(folder, report_data(page), messages, schemas, rows, events)


def shown(results: Results, rule: str, subject: str, signal: str) -> list[tuple[int, Any]]:
    """A signal as the page has it: times in nanoseconds, and values."""
    data = results.report
    entry = next(each for each in data["subjects"] if (each["rule"], each["subject"]) == (rule, subject))
    series = data["series"][entry["signals"][signal]]
    found, time = [], int(data["beginNs"])
    for difference, value in zip(series["t"], series["v"], strict=True):
        time += difference * data["unit"]
        found.append((time, value))
    return found


def logged(results: Results, rule: str, subject: str, signal: str) -> dict[int, Any]:
    """A signal as the MCAP file has it."""
    found = {}
    for time, message in results.messages[f"/wayside/{rule}/{subject}"]:
        value = message
        for step in message_path(signal):
            value = value.get(step, {}) if isinstance(value, dict) else {}
        found[time] = None if value == {} else value
    return found


@pytest.mark.parametrize(
    ("rule", "subject", "signal"),
    [
        ("too-fast", "car0", "speed"),
        ("too-fast", "car2", "speed"),
        ("harsh", "car1", "fastest - speed"),
        ("close", "car0+car1", "distance"),
        ("close", "car0+car1", "a.speed"),
        ("close", "car0+car1", "nearest"),
        ("close", "car0+car1", "contact"),
        ("harsh", "car1", "margin"),
        ("slow-one", "~fleet", "count"),
    ],
)
def test_a_signal_has_the_same_numbers_in_the_report_and_in_the_mcap_file(
    results: Results, rule: str, subject: str, signal: str
) -> None:
    in_file = logged(results, rule, subject, signal)
    on_page = shown(results, rule, subject, signal)
    assert on_page
    assert [(time, in_file[time]) for time, _ in on_page] == on_page


def test_the_table_has_the_numbers_of_the_report_and_of_the_events(results: Results) -> None:
    started = {event["data"]["episode"]: event for event in results.events if event["type"].endswith("started")}
    assert len(results.rows) == len(started) > 10
    checked = 0
    for row in results.rows:
        event = started[row["episode"]]
        assert row["start_time"] == parse_time(event["data"]["startTime"])
        for name, value in event["data"]["values"].items():
            if isinstance(value, float | bool | str):
                assert row[f"{name}.start"] == value
        for name in ("speed", "distance"):
            if row.get(f"{name}.max") is None or row["end_time"] is None:
                continue
            series = shown(results, row["rule"], row["subject"], name)
            begin, end = row["start_time"], row["end_time"]
            before = [value for time, value in series if time <= begin][-1:]
            inside = [value for time, value in series if begin < time <= end]
            values = [value for value in before + inside if value is not None]
            assert max(values) == row[f"{name}.max"]
            assert min(values) == row[f"{name}.min"]
            assert min(values) - HAIR <= row[f"{name}.mean"] <= max(values) + HAIR
            checked += 1
    assert checked > 10


def test_the_csv_file_has_the_rows_of_the_parquet_file(results: Results) -> None:
    with (results.folder / "out/episodes.csv").open(newline="") as file:
        rows = [*csv.DictReader(file)]
    assert [row["episode"] for row in rows] == [row["episode"] for row in results.rows]
    for text, row in zip(rows, results.rows, strict=True):
        assert text["start_time"] == format_time(row["start_time"])
        assert (float(text["speed.max"]) if text["speed.max"] else None) == row["speed.max"]
        assert text["subjects"] == "+".join(row["subjects"])


def test_near_misses_are_listed_by_margin_outside_of_episodes(results: Results) -> None:
    with (results.folder / "out/nearest.csv").open(newline="") as file:
        rows = [*csv.DictReader(file)]
    margins = [float(row["margin"]) for row in rows]
    assert margins == sorted(margins, reverse=True)
    assert {row["rule"] for row in rows} == {"harsh"}
    assert 0 < len(rows) <= 10
    assert [margin for *_, margin in results.report["nearest"]] == margins
    for row in rows:
        margin = dict(shown(results, "harsh", row["subject"], "margin"))
        assert margin[parse_time(row["time"])] == float(row["margin"])
        of_subject = [each for each in results.rows if (each["rule"], each["subject"]) == ("harsh", row["subject"])]
        assert not any(each["onset_time"] <= parse_time(row["time"]) <= each["end_time"] for each in of_subject)


def test_each_json_message_has_only_fields_of_its_schema(results: Results) -> None:
    for topic, schema in results.schemas.items():
        for _, message in results.messages[topic]:
            assert_declared(message, schema)


def assert_declared(value: Any, schema: dict[str, Any]) -> None:
    if isinstance(value, dict) and "properties" in schema:
        assert value.keys() <= schema["properties"].keys()
        for name, child in value.items():
            assert_declared(child, schema["properties"][name])


def test_the_mcap_file_has_the_conditions_and_why_they_are_unknown(results: Results) -> None:
    messages = results.messages["/wayside/too-fast/car2"]
    unknown = [(time, message) for time, message in messages if message["when"] == "unknown"]
    assert (unknown[0][0] - START) / SECOND == pytest.approx(21.1)
    assert unknown[0][1]["when_reason"] == "speed: stream odom is stale: its newest sample is 1.1 s old"
    assert {message["when"] for _, message in messages} == {"true", "false", "unknown"}
    assert messages[0][1]["threshold"] == {"when": {"speed": 21.0}, "until": {"speed": 18.0}}


def test_the_scene_has_a_line_while_a_pair_is_in_an_episode(results: Results) -> None:
    row = next(row for row in results.rows if row["rule"] == "close" and row["end_time"] is not None)
    begin, end = row["start_time"], row["end_time"]
    name = f"close {'+'.join(row['subjects'])}"
    with_line = {
        time
        for time, update in results.messages["/wayside/scene"]
        if any(entity.id == name and entity.lines for entity in update.entities)
    }
    times = {time for time, _ in results.messages["/wayside/scene"]}
    assert {time for time in times if begin <= time < end} <= with_line
    assert end not in with_line


def test_the_log_and_the_episodes_have_each_event(results: Results) -> None:
    assert len(results.messages["/wayside/log"]) == len(results.messages["/wayside/episodes"]) == len(results.events)


def test_the_report_loads_nothing_and_is_small(results: Results) -> None:
    page = (results.folder / "out/report.html").read_text()
    assert "default-src 'none'" in page
    assert not re.search(r"<(script|img|link|iframe)[^>]*(src|href)=", page)
    assert len(page) < 2_000_000


def test_the_report_has_the_rules_the_data_and_the_simulated_actions(results: Results) -> None:
    data = results.report
    assert [rule["name"] for rule in data["rules"]] == ["close", "harsh", "slow-one", "too-fast"]
    rule = data["rules"][-1]
    assert rule["description"] == "A vehicle is faster than it may be."
    assert "when: speed > parameters.limit" in rule["text"]
    (stream,) = data["streams"]
    assert (stream["samples"], stream["keys"], stream["rate"]) == (1721, 3, 10.0)
    assert stream["gapKey"] == "vehicles/car2/odom"
    assert stream["gap"] == pytest.approx(8.0)
    started = sum(row["rule"] == "too-fast" for row in results.rows)
    assert len(data["actions"]) == started
    assert data["actions"][0][3:5] == ["deploy", f'speed-watch: vehicle="{data["actions"][0][2]}"']
    assert [each["template"] for each in data["demands"]] == ["speed-watch"]
    assert [(each["name"], each["closed"]) for each in data["polygons"]] == [
        ("yard", True),
        ("gate", False),
        ("area", True),
    ]
    assert [each["client"] for each in data["paths"]] == ["car0", "car1", "car2"]


def test_results_change_neither_events_nor_tasks_and_are_the_same_each_time(tmp_path: Path, results: Results) -> None:
    recording, detector, rules = (results.folder / name for name in ("drive.jsonl", "detector.yaml", "rules.yaml"))
    replay_files([recording], tmp_path / "plain", detector, [rules], as_one=False)
    assert sorted(path.name for path in (tmp_path / "plain").iterdir()) == ["events.jsonl", "tasks.yaml"]
    for name in ("events.jsonl", "tasks.yaml"):
        assert (tmp_path / "plain" / name).read_bytes() == (results.folder / "out" / name).read_bytes()
    replay_files([recording], tmp_path / "again", detector, [rules], as_one=False, kinds=ALL)
    for path in (tmp_path / "again").iterdir():
        assert path.read_bytes() == (results.folder / "out" / path.name).read_bytes(), path.name


def test_each_of_several_recordings_has_separate_files(tmp_path: Path) -> None:
    recording, detector, rules = write(tmp_path)
    other = tmp_path / "other.jsonl"
    other.write_bytes(recording.read_bytes())
    replay_files([recording, other], tmp_path / "out", detector, [rules], as_one=False, kinds=ALL)
    assert {"report-1.html", "report-2.html", "results-1.mcap", "results-2.mcap"} <= {
        path.name for path in (tmp_path / "out").iterdir()
    }
    rows = table_of(tmp_path / "out/episodes.parquet")
    assert {row["recording"] for row in rows} == {str(recording), str(other)}


def test_a_missing_package_is_named_before_the_replay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording, detector, rules = write(tmp_path)
    monkeypatch.setattr(kinds, "find_spec", lambda name: None)
    with pytest.raises(kinds.MissingExtraError, match=r"mcap needs foxglove: pip install 'wayside\[results\]'"):
        replay_files([recording], tmp_path / "out", detector, [rules], as_one=False, kinds=frozenset({ResultKind.MCAP}))
    assert not (tmp_path / "out").exists()


def test_an_intake_file_with_rule_changes_has_results_too(tmp_path: Path) -> None:
    detector, rules = documents(tmp_path)
    samples = arrivals()
    half = len(samples) // 2
    writer = IntakeWriter(tmp_path / "intake.mcap", detector.spec.streams)
    start = {"kind": "start", "version": ORDER, "holder": "desk", "detector": detector.to_json()}
    first = [rule.to_json() for rule in rules]
    first[0]["spec"]["signals"] = first[0]["spec"]["signals"][:1]  # blocks with texts are noted at once, others wait
    writer.control(START - 1, {**start, "rules": first})
    writer.arrivals(samples[:half])
    changed = [rule.to_json() for rule in rules]
    gear = {"name": "gear", "stream": "odom", "value": "msg.gear"}
    pace = {"name": "pace", "stream": "odom", "value": "msg.speed"}
    changed[0]["spec"] |= {"signals": [pace, gear], "when": "pace > 20"}
    changed[0]["spec"]["until"] = "pace < 10"
    changed[2]["spec"] |= {"when": "distance < 60", "signals": []}
    middle = samples[half - 1].received
    writer.control(middle, {"kind": "rules", "until": middle, "rules": changed})
    writer.arrivals(samples[half:])
    end = samples[-1].received
    writer.control(end, {"kind": "end", "until": end, "finished": True})
    writer.close()
    replay_files([tmp_path / "intake.mcap"], tmp_path / "out", None, [], as_one=False, kinds=ALL)
    rows = table_of(tmp_path / "out/episodes.parquet")
    assert {row["reason"] for row in rows} >= {"RuleChanged", "Until"}
    later = [row for row in rows if row["rule"] == "too-fast" and row["start_time"] > middle]
    assert later
    for row in later:
        assert row["pace.start"] > 20
        assert row["pace.max"] >= row["pace.start"]
    data = report_data((tmp_path / "out/report.html").read_text())
    assert data["streams"][0]["samples"] == len(samples)
    assert sum(rule["episodes"] for rule in data["rules"]) == len(rows)
    for subject in data["subjects"]:
        times = [data["series"][place]["t"] for place in subject["signals"].values()]
        times += [steps["t"] for steps in subject["conditions"].values()]
        assert all(difference >= 0 for each in times for difference in each)
