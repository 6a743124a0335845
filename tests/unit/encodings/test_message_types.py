"""ROS 2 message types of one's own: defined in the Detector, or by the recording that is replayed."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import Reader as BagReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from typer.testing import CliRunner

from detector.assembly import DetectorError, stream_readers
from detector.assembly.checking import findings
from detector.commands.cli import app
from detector.engine.samples.sample import Arrival
from detector.replay.intake_writer import IntakeWriter
from detector.replay.message import RecordingError
from detector.replay.recorded_types import with_recorded_types
from detector.streams.codecs import CdrDecoder
from detector.streams.codecs.definitions import Definition, DefinitionsError
from detector.streams.codecs.ros import types_with
from detector.testing import run
from tests.driving import Drive, a_detector, a_rule, at
from tests.guides import guide, yaml_blocks
from tests.unit.encodings import hostile
from wayside.api import Detector
from wayside.api.documents import DocumentError, load_documents

TRACKS = "fleet_msgs/msg/Tracks"
TEXTS = {
    TRACKS: """\
# What a perception sees.
uint8 CAR=1
uint32 sequence
std_msgs/Header header
Track[<=8] tracks
string<=16 sensor "lidar"
""",
    "fleet_msgs/msg/Track": "uint64 id\nuint8 kind\ngeometry_msgs/Point[2] corners\nfloat32[] history\nNote note\n",
    "fleet_msgs/msg/Note": "string[] lines\nbool class\nbyte[4] code\n",
}
DEFINITIONS = tuple(Definition(name, text) for name, text in TEXTS.items())
MESSAGES = [{"name": name, "definition": text} for name, text in TEXTS.items()]
STREAM = {"name": "tracks", "key": "vehicles/${client:*}/tracks", "encoding": "cdr", "type": TRACKS}
CROWDED = a_rule("crowded", signals=[{"name": "n", "stream": "tracks", "value": "size(msg.tracks)"}], when="n > 1")


def other_store(texts: dict[str, str] = TEXTS) -> Typestore:
    """A store as another program would make it, of another release."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in reversed(texts.items()):
        store.register(get_types_from_msg(text, name))
    return store


def message(store: Typestore, count: int = 2, seconds: int = 5) -> Any:
    of = {name.rsplit("/", 1)[-1]: kind for name, kind in store.types.items()}
    note = of["Note"](["a", "ü"], True, np.array([1, 2, 3, 255], np.uint8))
    corners = [of["Point"](1.0, 2.0, 3.0), of["Point"](4.0, 5.0, 6.0)]
    tracks = [of["Track"](2**60 + n, 1, corners, np.array([0.5, 1.5], np.float32), note) for n in range(count)]
    header = of["Header"](store.types["builtin_interfaces/msg/Time"](seconds, 7), "map")
    return of["Tracks"](9, header, tracks, "radar")


def cdr(store: Typestore, value: Any, *, little_endian: bool = True) -> bytes:
    return bytes(store.serialize_cdr(value, value.__msgtype__, little_endian=little_endian))


@pytest.mark.parametrize("little_endian", [True, False])
def test_a_nested_type_reads_as_another_program_wrote_it(little_endian: bool) -> None:
    store = other_store()
    raw = cdr(store, message(store, 1), little_endian=little_endian)
    decoder = CdrDecoder(TRACKS, types_with(DEFINITIONS))
    assert decoder.decode(raw) == {
        "sequence": 9.0,
        "header": {"stamp": {"sec": 5.0, "nanosec": 7.0}, "frame_id": "map"},
        "tracks": [
            {
                "id": 2**60,
                "kind": 1.0,
                "corners": [{"x": 1.0, "y": 2.0, "z": 3.0}, {"x": 4.0, "y": 5.0, "z": 6.0}],
                "history": [0.5, 1.5],
                "note": {"lines": ["a", "ü"], "class": True, "code": b"\x01\x02\x03\xff"},
            }
        ],
        "sensor": "radar",
    }
    assert decoder.stamp(raw) == 5 * 10**9 + 7


def test_a_text_may_hold_all_that_it_refers_to() -> None:
    whole = types_with(DEFINITIONS).definition(TRACKS)
    assert whole.count("MSG: ") > 3
    types = types_with((Definition(TRACKS, whole),))
    assert types.fields(TRACKS) == types_with(DEFINITIONS).fields(TRACKS)
    windows = whole.replace("\n", "\r\n").replace("=" * 80, "===")
    assert types_with((Definition(TRACKS, windows),)).fields(TRACKS) == types.fields(TRACKS)


@pytest.mark.parametrize(
    ("fields", "stamped"),
    [
        ("std_msgs/Header header\nint32 x", True),
        ("int32 x\nHeader header", True),
        ("string text\nint8[] more\nstd_msgs/msg/Header header", True),
        ("int32 x\nstd_msgs/Header other", False),
        ("int32 x\nfloat64 header", False),
        ("int32 x", False),
    ],
)
def test_the_stamp_is_that_of_the_header_at_any_position(fields: str, stamped: bool) -> None:
    store = other_store({"a_msgs/msg/A": fields})
    empty = {"x": 1, "text": "abc", "more": np.array([1], np.int8)}
    header = store.types["std_msgs/msg/Header"](store.types["builtin_interfaces/msg/Time"](8, 9), "")
    names = [line.split()[1] for line in fields.splitlines()]
    kind = store.types["a_msgs/msg/A"]
    values = {name: header if name in ("header", "other") else empty[name] for name in names if name != "header"}
    if "header" in names:
        values["header"] = 1.5 if "float64" in fields else header
    raw = cdr(store, kind(**values))
    decoder = CdrDecoder("a_msgs/msg/A", types_with((Definition("a_msgs/msg/A", fields),)))
    assert decoder.stamp(raw) == (8 * 10**9 + 9 if stamped else None)


def test_a_type_of_the_common_packages_may_be_defined_otherwise() -> None:
    own = (
        Definition("std_msgs/msg/Header", "uint32 seq\nbuiltin_interfaces/Time stamp\nstring frame_id"),
        Definition("a_msgs/msg/A", "std_msgs/Header header"),
    )
    raw = b"\x00\x01\x00\x00" + b"".join(n.to_bytes(4, "little") for n in (1, 5, 7, 1)) + b"\x00"
    decoder = CdrDecoder("a_msgs/msg/A", types_with(own))
    assert decoder.decode(raw)["header"] == {"seq": 1.0, "stamp": {"sec": 5.0, "nanosec": 7.0}, "frame_id": ""}
    assert decoder.stamp(raw) == 5 * 10**9 + 7
    assert CdrDecoder("std_msgs/msg/Header").stamp(raw) is None


def test_ten_thousand_hostile_payloads_give_a_message_or_a_decode_error() -> None:
    store = other_store()
    valid = [cdr(store, message(store, 3)), cdr(store, message(store), little_endian=False)]
    refused = hostile.survive(CdrDecoder(TRACKS, types_with(DEFINITIONS)), hostile.payloads(valid, 10_000, seed=1))
    assert 3000 < refused < 9900


def wrong(*texts: tuple[str, str]) -> dict[str, str]:
    with pytest.raises(DefinitionsError) as caught:
        types_with(tuple(Definition(name, text) for name, text in texts))
    return dict(caught.value.problems)


A, B = "a_msgs/msg/A", "a_msgs/msg/B"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("int32 x\nfloat64\n", "line 2: 'float64' is not a line"),
        ("int32 x\n\n# ok\nint32 ü", "line 4: 'int32 ü' is not a line"),
        ("int32 x\nint64 x", "line 1: x is given twice"),
        ("int32 x\nB b", "line 2: b has the type a_msgs/msg/B, which is unknown"),
        ("other/B[] b", "line 1: b has the type other/msg/B, which is unknown"),
        ("int32 x\n===\nMSG: other/B\nint8 y\nC c", "line 5: c has the type other/msg/C, which is unknown"),
        ("wstring w", "wide strings"),
        ("int32[99999999999] x", "x has 99999999999 elements"),
        ("A a", r"contains itself (a_msgs/msg/A → a_msgs/msg/A)"),
        ("MSG: other/B\nint8 y", "a line of `=`"),
        (f"int32 X={'9' * 5000}", "line 1: 'int32 X=999"),
    ],
)
def test_errors_in_a_definition_are_reported_with_their_line(text: str, words: str) -> None:
    assert words in wrong((A, text))[A]


def test_errors_between_definitions_are_reported() -> None:
    assert "a_msgs/msg/A → a_msgs/msg/B → a_msgs/msg/A" in wrong((A, "B b"), (B, "A a"))[A]
    assert "defines a_msgs/msg/A differently" in wrong((A, "int32 x"), (B, "A a\n===\nMSG: a_msgs/A\nint64 x"))[B]
    chain = [(f"a_msgs/msg/N{n}", f"N{n + 1} one\nN{n + 1} two") for n in range(70)]
    assert any("nested more than 64 deep" in text for text in wrong(*chain, ("a_msgs/msg/N70", "int8 x")).values())


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_any_text_is_a_definition_or_an_error(data: st.DataObject) -> None:
    text = data.draw(st.sampled_from([*TEXTS.values(), ""]))
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(text)))
        text = text[:place] + data.draw(st.text(max_size=6)) + text[place + data.draw(st.integers(0, 4)) :]
    try:
        types = types_with((Definition(TRACKS, text),))
    except DefinitionsError:
        pass
    else:
        hostile.survive(CdrDecoder(TRACKS, types), iter([b"\x00\x01\x00\x00" + bytes(64)]))


DETECTOR = """\
apiVersion: wayside.dev/v1alpha1
kind: Detector
metadata: {name: d}
spec:
  streams:
    - {name: tracks, key: "vehicles/${client:*}/tracks", encoding: cdr, type: fleet_msgs/msg/Tracks}
    - {name: others, key: "vehicles/${client:*}/others", encoding: cdr, type: fleet_msgs/msg/Others}
  messages:
    - name: fleet_msgs/msg/Tracks
      definition: |
        std_msgs/Header header
        Track[] tracks
---
apiVersion: wayside.dev/v1alpha1
kind: EventRule
metadata: {name: r}
spec:
  signals: [{name: n, stream: tracks, value: msg.header.stamp.secs}]
  when: n > 1
"""


def problems(path: Path, text: str) -> list[str]:
    path.write_text(text)
    try:
        return [str(problem).removeprefix(f"{path}:") for problem in findings(load_documents([path])).problems]
    except DocumentError as error:
        return [str(problem).removeprefix(f"{path}:") for problem in error.problems]


def test_check_reports_where_a_definition_is_missing_or_wrong(tmp_path: Path) -> None:
    path = tmp_path / "d.yaml"
    others, tracks = sorted(problems(path, DETECTOR))
    assert others.startswith("10:19: spec.messages[0].definition: line 2: tracks has the type fleet_msgs/msg/Track")
    assert tracks.startswith("7:79: spec.streams[1].type: streams[others].type: unknown message type")
    assert "give its definition in spec.messages" in tracks
    whole = DETECTOR.replace("Others}", "Tracks}").replace("Track[] tracks", "float64[] tracks")
    (misspelt,) = problems(path, whole)
    assert "msg.header.stamp has no field secs; did you mean sec? (stream tracks" in misspelt
    assert problems(path, whole.replace("secs", "sec")) == []
    (twice,) = problems(path, whole.replace("---", '    - {name: fleet_msgs/msg/Tracks, definition: ""}\n---'))
    assert "messages: the name 'fleet_msgs/msg/Tracks' is used twice" in twice
    (misnamed,) = problems(path, whole.replace("- name: fleet_msgs/msg/", "- name: fleet_msgs/"))
    assert "spec.messages[0].name" in misnamed


def test_rules_are_evaluated_over_a_type_of_the_detector(tmp_path: Path) -> None:
    store = other_store()
    drive = Drive(a_detector(STREAM, messages=MESSAGES), CROWDED)
    samples = [Arrival(at(n + 0.5), "tracks", "vehicles/car/tracks", cdr(store, message(store, n))) for n in range(4)]
    assert drive.take(*samples, until=4) == ["crowded car started 3"]
    assert not drive.engine.counters.undecodable


def test_samples_of_a_type_that_is_redefined_are_not_read_by_the_new_definition() -> None:
    store = other_store()
    detector = a_detector(STREAM, messages=MESSAGES)
    drive = Drive(detector, CROWDED)
    drive.take(Arrival(at(0.5), "tracks", "vehicles/car/tracks", cdr(store, message(store))), until=1)
    assert len(list(drive.engine.buffer)) == 1
    changed = a_detector(STREAM, messages=[{"name": TRACKS, "definition": "int32[] tracks"}])
    readers = stream_readers(changed)
    drive.engine.set_detector(changed, readers.decoders, readers.read_key)
    assert list(drive.engine.buffer) == []


def test_an_intake_file_holds_the_definition_for_other_programs(tmp_path: Path) -> None:
    store = other_store()
    detector = a_detector(STREAM, messages=MESSAGES)
    writer = IntakeWriter(tmp_path / "intake.mcap", detector.spec.streams, stream_readers(detector).types)
    raw = cdr(store, message(store))
    writer.arrivals([Arrival(10, "tracks", "vehicles/car/tracks", raw)])
    writer.close()
    with BagReader(tmp_path / "intake.mcap") as bag:
        (connection,) = [each for each in bag.connections if each.msgtype == TRACKS]
        reading = get_typestore(Stores.ROS2_HUMBLE)
        reading.register(get_types_from_msg(connection.msgdef.data, TRACKS))
        ((_, _, recorded),) = bag.messages([connection])
    assert [track.id for track in reading.deserialize_cdr(recorded, TRACKS).tracks] == [2**60, 2**60 + 1]  # type: ignore[attr-defined]


def write_bag(path: Path, store: Typestore, storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
    with BagWriter(path, version=9, storage_plugin=storage) as bag:
        connection = bag.add_connection("/vehicles/car/tracks", TRACKS, typestore=store)
        for second in range(1, 5):
            bag.write(connection, at(second + 0.5), cdr(store, message(store, second)))
    return path


@pytest.mark.parametrize("storage", StoragePlugin)
def test_a_recording_brings_its_definitions_along(tmp_path: Path, storage: StoragePlugin) -> None:
    bag = write_bag(tmp_path / "bag", other_store(), storage)
    (tmp_path / "detector.yaml").write_text(
        DETECTOR.split("  messages:", maxsplit=1)[0].replace("type: fleet_msgs/msg/Others", "type: std_msgs/msg/String")
    )
    (tmp_path / "rules.yaml").write_text(
        "apiVersion: wayside.dev/v1alpha1\nkind: EventRule\nmetadata: {name: crowded}\n"
        'spec:\n  signals: [{name: n, stream: tracks, value: "size(msg.tracks)"}]\n  when: n > 1\n'
    )
    arguments = ["replay", str(bag), "--output", str(tmp_path / "out"), "--detector", str(tmp_path / "detector.yaml")]
    result = CliRunner().invoke(app, [*arguments, "--rules", str(tmp_path / "rules.yaml")])
    assert result.exit_code == 0, result.output
    (event,) = (tmp_path / "out" / "events.jsonl").read_text().splitlines()
    assert '"rule":"crowded"' in event
    (tested,) = run(tmp_path / "rules.yaml", tmp_path / "detector.yaml", bag)
    assert tested.to_json() == event


def test_the_definition_of_the_recording_counts_before_that_of_the_detector(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", other_store())
    other = a_detector(STREAM, messages=[{"name": TRACKS, "definition": "int32 x"}, MESSAGES[1], MESSAGES[2]])
    fields = stream_readers(with_recorded_types(other, [bag])).fields["tracks"]
    assert [*fields] == ["sequence", "header", "tracks", "sensor"]
    same = a_detector(STREAM, messages=MESSAGES)
    assert with_recorded_types(same, [bag]) is same


def mcap(path: Path, text: str, encoding: str = "ros2msg") -> Path:
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        channel = writer.register_channel(
            "/vehicles/car/tracks", "cdr", writer.register_schema(TRACKS, encoding, text.encode())
        )
        writer.add_message(channel, 1, b"\x00\x01\x00\x00", 1)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


IDL = """\
module fleet_msgs {
  module msg {
    struct Tracks {
      int32 count;
      sequence<double> places;
    };
  };
};
"""


def with_recorded(*paths: Path) -> Detector:
    return with_recorded_types(a_detector(STREAM), paths)


def test_definitions_in_idl_are_understood(tmp_path: Path) -> None:
    completed = with_recorded(mcap(tmp_path / "a.mcap", IDL, "ros2idl"))
    assert [*stream_readers(completed).fields["tracks"]] == ["count", "places"]


def test_recordings_that_define_a_type_differently_are_not_mixed(tmp_path: Path) -> None:
    same = [mcap(tmp_path / "a.mcap", "int32 x"), mcap(tmp_path / "b.mcap", "int32  x  # the same")]
    assert [*stream_readers(with_recorded(*same)).fields["tracks"]] == ["x"]
    with pytest.raises(
        RecordingError, match=r"c\.mcap: fleet_msgs/msg/Tracks differs from its definition in .*a\.mcap"
    ):
        with_recorded(*same, mcap(tmp_path / "c.mcap", "float32 x"))


@pytest.mark.parametrize(("text", "encoding"), [("int32", "ros2msg"), ("struct {", "ros2idl"), ("", "ros2idl")])
def test_a_definition_that_cannot_be_read_is_an_error_unless_the_type_is_known(
    tmp_path: Path, text: str, encoding: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = mcap(tmp_path / "a.mcap", text, encoding)
    if text:
        with pytest.raises(
            RecordingError, match=r"a\.mcap: cannot read the recorded definition of fleet_msgs/msg/Tracks"
        ):
            with_recorded(path)
    known = a_detector(STREAM, messages=MESSAGES)
    assert with_recorded_types(known, [path]) is known
    assert ("using the known one" in caplog.text) is bool(text)


def test_an_incomplete_definition_in_a_recording_is_reported(tmp_path: Path) -> None:
    with pytest.raises(
        DetectorError, match=r"messages\[0\]\.definition: line 1: x has the type fleet_msgs/msg/Nowhere"
    ):
        stream_readers(with_recorded(mcap(tmp_path / "a.mcap", "Nowhere x")))


def test_the_documentation_s_examples_are_streams_that_run() -> None:
    blocks = [document for block in yaml_blocks(guide("encodings")) for document in yaml.safe_load_all(block)]
    streams = [each for each in blocks if "streams" in each]
    assert len(streams) >= 2
    for example in streams:
        readers = stream_readers(a_detector(*example.pop("streams"), **example))
        assert readers.decoders


def test_many_definitions_are_taken_in_quickly() -> None:
    many = tuple(Definition(f"a_msgs/msg/N{n}", f"N{n + 1} one\nN{n + 1} two") for n in range(50))
    begin = time.monotonic()
    types_with((*many, Definition("a_msgs/msg/N50", "int8 x")))
    assert time.monotonic() - begin < 60
