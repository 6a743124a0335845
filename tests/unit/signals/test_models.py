"""Signals from ONNX models: real models through onnxruntime, and their errors."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import yaml
from onnx import helper
from rosbags.typesys import Stores, get_typestore

from detector.assembly import RuleIndex, make_engine, stream_readers
from detector.assembly.checking import findings
from detector.engine.samples.sample import Arrival
from tests import onnx_models
from tests.driving import SPEED, Drive, a_detector, a_rule, a_stream, arrival, at
from tests.guides import guide, yaml_blocks
from wayside.api import Detector, EventRule
from wayside.api.documents import load_documents

GAP = {"name": "gap", "stream": "pose", "value": "msg.x"}
STORE = get_typestore(Stores.ROS2_JAZZY)


def risk(file: Path, *inputs: dict[str, Any], name: str = "risk", **fields: Any) -> dict[str, Any]:
    return {"name": name, "model": {"file": str(file), "inputs": list(inputs), **fields}}


def x(**given: Any) -> dict[str, Any]:
    return {"name": "x", **given}


class ModelDrive(Drive):
    """As `Drive`, with the models of its rules."""

    def __init__(self, detector: Detector, *rules: EventRule) -> None:
        super().__init__(detector)
        readers = stream_readers(detector)
        compiled, refused = RuleIndex().compile(rules, detector, readers.fields)
        assert not refused, [str(each) for each in refused]
        self.engine = make_engine(detector, readers, holder="h", start=at(0))
        self.engine.set_rules(compiled)

    def values(self) -> Any:
        """Of the newest event."""
        return self.events[-1].values


def always(*signals: Any, **spec: Any) -> EventRule:
    """A rule whose episode starts at once for each client, so that the event has its signals."""
    return a_rule("r", signals=list(signals), when="true", **spec)


def test_a_models_output_is_a_signal_and_its_sha256_is_in_the_event(tmp_path: Path) -> None:
    file = onnx_models.weighted(tmp_path / "m.onnx", [0.5, -1.0], bias=2.0)
    rule = a_rule("r", signals=[SPEED, GAP, risk(file, x(signals=["speed", "gap"]))], when="risk > 5")
    drive = ModelDrive(a_detector(), rule)
    assert drive.take(arrival(0.4, "car", {"v": 10}), arrival(0.5, "car", {"x": 4}, "pose"), until=1) == []
    drive.take(arrival(1.5, "car", {"v": 20}), until=2)
    assert drive.values() == {"speed": 20.0, "gap": 4.0, "risk": 8.0}
    sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
    assert drive.events[-1].cloud_event()["data"]["models"] == {"risk": sha256}


def test_all_clients_of_a_tick_are_one_batch_without_those_with_unknown_inputs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from detector.onnx.loading import ModelFile

    batches: list[int] = []
    original = ModelFile.run_rows

    def counted(self: ModelFile, rows: Any) -> Any:
        batches.append(len(rows))
        return original(self, rows)

    file = onnx_models.weighted(tmp_path / "m.onnx", [1.0])
    drive = ModelDrive(a_detector(), always(SPEED, risk(file, x(signals=["speed"]))))
    monkeypatch.setattr(ModelFile, "run_rows", counted)
    sent = [arrival(0.1 + n / 100, f"car{n}", {"v": n} if n else {}) for n in range(5)]
    drive.take(*sent, until=1)
    assert batches == [4]
    assert [event.values for event in drive.events] == [
        {},
        *({"speed": float(n), "risk": float(n)} for n in range(1, 5)),
    ]


def test_a_model_for_a_single_client_runs_once_for_each_client(tmp_path: Path) -> None:
    file = onnx_models.weighted(tmp_path / "m.onnx", [1.0], clients=1)
    drive = ModelDrive(a_detector(), always(SPEED, risk(file, x(signals=["speed"]))))
    drive.take(arrival(0.1, "a", {"v": 1}), arrival(0.2, "b", {"v": 2}), until=1)
    assert [event.values["risk"] for event in drive.events] == [1.0, 2.0]


def test_the_last_samples_are_a_window_oldest_first_and_unknown_while_there_are_fewer(tmp_path: Path) -> None:
    file = onnx_models.weighted(tmp_path / "m.onnx", [100.0, 10.0, 1.0])
    signal = risk(file, x(window={"signals": ["speed"], "last": 3}))
    drive = ModelDrive(a_detector(), a_rule("r", signals=[SPEED, signal], when="risk > 0"))
    assert drive.take(arrival(0.1, "car", {"v": 1}), arrival(0.2, "car", {"v": 2}), until=1) == []
    drive.take(arrival(1.1, "car", {"v": 3}), until=2)
    assert drive.values()["risk"] == 123.0


def test_a_time_window_is_resampled_at_equal_steps(tmp_path: Path) -> None:
    file = onnx_models.same(tmp_path / "m.onnx", [3, 2])
    window = {"signals": ["speed", "gap"], "over": "2s", "samples": 3}
    drive = ModelDrive(
        a_detector(), a_rule("r", signals=[SPEED, GAP, risk(file, x(window=window))], when="risk[0][0] >= 0")
    )
    sent = [arrival(0.5, "car", {"v": 0}), arrival(0.5, "car", {"x": 5}, "pose"), arrival(2.5, "car", {"v": 20})]
    assert drive.take(*sent, until=2) == []  # at 2, a window of two seconds begins before the first sample
    drive.take(until=3)
    assert drive.values()["risk"] == [[5.0, 5.0], [15.0, 5.0], [20.0, 5.0]]


def test_several_outputs_are_a_map_and_output_names_one(tmp_path: Path) -> None:
    file = onnx_models.two_outputs(tmp_path / "m.onnx")
    both, one = (
        risk(file, x(signals=["speed", "gap"])),
        risk(file, x(signals=["speed", "gap"]), name="h", output="high"),
    )
    drive = ModelDrive(a_detector(), a_rule("r", signals=[SPEED, GAP, both, one], when="risk.low[1] > 0 && h[0] > 0"))
    drive.take(arrival(0.4, "car", {"v": 10}), arrival(0.5, "car", {"x": 4}, "pose"), until=1)
    assert drive.values()["risk"] == {"low": [9.0, 3.0], "high": [11.0, 5.0]}
    assert drive.values()["h"] == [11.0, 5.0]


def test_in_a_pair_each_client_has_its_own_value(tmp_path: Path) -> None:
    file = onnx_models.weighted(tmp_path / "m.onnx", [1.0])
    scope = {"pairs": {"position": {"stream": "pose", "x": "msg.x", "y": "msg.y"}, "within": 100}}
    rule = a_rule("r", scope=scope, signals=[SPEED, risk(file, x(signals=["speed"]))], when="a.risk + b.risk > 5")
    drive = ModelDrive(a_detector(), rule)
    for n, car in enumerate("abc"):
        where = {"x": 1000.0 if car == "c" else 0.0, "y": 0}
        drive.take(arrival(0.1 + n / 10, car, {"v": n + 3}), arrival(0.15 + n / 10, car, where, "pose"), until=0.5)
    assert drive.take(until=1) == ["r a+b started 1"]
    assert drive.values()["b"]["risk"] == 4.0


def an_image(pixels: Any, encoding: str = "rgb8", **fields: Any) -> bytes:
    array = np.asarray(pixels)
    header = STORE.types["std_msgs/msg/Header"](STORE.types["builtin_interfaces/msg/Time"](0, 0), "cam")
    height, width = array.shape[:2]
    data = np.frombuffer(array.tobytes(), np.uint8)
    values = {"step": len(data) // height, "is_bigendian": 0, "width": width, "height": height} | fields
    message = STORE.types["sensor_msgs/msg/Image"](header=header, encoding=encoding, data=data, **values)
    return bytes(STORE.serialize_cdr(message, "sensor_msgs/msg/Image"))


def a_cloud(rows: Any) -> bytes:
    array = np.asarray(rows, np.float32)
    header = STORE.types["std_msgs/msg/Header"](STORE.types["builtin_interfaces/msg/Time"](0, 0), "lidar")
    fields = [STORE.types["sensor_msgs/msg/PointField"](name, 4 * n, 7, 1) for n, name in enumerate("xyzi")]
    data = np.frombuffer(array.tobytes(), np.uint8)
    cloud = STORE.types["sensor_msgs/msg/PointCloud2"](
        header=header,
        height=1,
        width=len(array),
        fields=fields,
        is_bigendian=False,
        point_step=16,
        row_step=16 * len(array),
        data=data,
        is_dense=False,
    )
    return bytes(STORE.serialize_cdr(cloud, "sensor_msgs/msg/PointCloud2"))


CAMERA = a_stream("camera", encoding="cdr", type="sensor_msgs/msg/Image")
LIDAR = a_stream("lidar", encoding="cdr", type="sensor_msgs/msg/PointCloud2")


def sensed(tmp_path: Path, shape: list[int], given: dict[str, Any], payload: bytes, stream: str) -> Drive:
    signal = risk(onnx_models.same(tmp_path / "m.onnx", shape), x(**given), name="out")
    drive = ModelDrive(a_detector(CAMERA, LIDAR), always(signal))
    drive.take(arrival(0.5, "car", payload, stream), until=1)
    return drive


def test_an_image_becomes_a_tensor_with_size_channels_and_scale_as_declared(tmp_path: Path) -> None:
    pixels = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    given = {
        "stream": "camera",
        "width": 3,
        "height": 2,
        "channels": "Bgr",
        "scale": 0.5,
        "mean": [1, 2, 3],
        "std": [1, 1, 2],
    }
    drive = sensed(tmp_path, [3, 2, 3], {"image": given}, an_image(pixels), "camera")
    nearest = pixels[::2, ::2, ::-1].astype(float) * 0.5
    expected = ((nearest - [1, 2, 3]) / [1, 1, 2]).transpose(2, 0, 1)
    assert drive.values()["out"] == expected.tolist()


@pytest.mark.parametrize(
    ("encoding", "array", "expected"),
    [
        ("mono8", np.uint8([[7]]), [7.0]),
        ("16UC1", np.array([[700]], "<u2"), [700.0]),
        ("32FC1", np.array([[1.5]], "<f4"), [1.5]),
        ("bgra8", np.uint8([[[1, 2, 3, 255]]]), [3.0, 2.0, 1.0]),
        ("8UC3", np.uint8([[[1, 2, 3]]]), [3.0, 2.0, 1.0]),
    ],
)
def test_the_usual_encodings_of_pixels(tmp_path: Path, encoding: str, array: Any, expected: list[float]) -> None:
    channels = "Gray" if len(expected) == 1 else "Rgb"
    given = {"stream": "camera", "width": 1, "height": 1, "channels": channels}
    drive = sensed(tmp_path, [len(expected), 1, 1], {"image": given}, an_image(array, encoding), "camera")
    out = drive.values()["out"]
    assert (np.ravel(out) if len(expected) > 1 else [out]) == pytest.approx(expected)


def test_a_point_cloud_becomes_padded_rows_of_fields_without_nan(tmp_path: Path) -> None:
    rows = [[1, 2, 3, 10], [np.nan, 0, 0, 0], [4, 5, 6, 20]]
    given = {"stream": "lidar", "fields": ["z", "i"], "count": 3, "scale": [1, 0.1]}
    drive = sensed(tmp_path, [3, 2], {"points": given}, a_cloud(rows), "lidar")
    assert np.array(drive.values()["out"]) == pytest.approx(np.array([[3, 1], [6, 2], [0, 0]]))


def test_beyond_the_maximum_every_nth_point_is_used(tmp_path: Path) -> None:
    given = {"stream": "lidar", "fields": ["x"], "count": 4}
    drive = sensed(tmp_path, [4, 1], {"points": given}, a_cloud([[n, 0, 0, 0] for n in range(8)]), "lidar")
    assert drive.values()["out"] == [[0.0], [2.0], [4.0], [6.0]]


@pytest.mark.parametrize(
    ("payload", "logged"),
    [
        (an_image(np.uint8([[[1, 2, 3]]]), "yuv422"), "image encoding 'yuv422' is not supported; use one of mono8"),
        (an_image(np.uint8([[[1, 2, 3]]]), height=9), "image of 1 x 9 rgb8 with step 3 does not fit 3 bytes"),
        (b"\0\1\0\0nonsense", "not a valid sensor_msgs/msg/Image"),
    ],
)
def test_an_invalid_image_is_unknown_and_counted_as_an_error(tmp_path: Path, payload: bytes, logged: str) -> None:
    given = {"stream": "camera", "width": 1, "height": 1}
    drive = sensed(tmp_path, [3, 1, 1], {"image": given}, payload, "camera")
    assert drive.values() == {}
    counters = drive.engine.counters.rule("r")
    assert counters.errors == 1
    assert logged in counters.last_error


def test_a_model_that_fails_at_run_time_is_unknown_and_counted(tmp_path: Path) -> None:
    # Gather fails where the index, the speed, is out of range; with zeros it does not.
    nodes = [
        helper.make_node("Cast", ["x"], ["i"], to=onnx.TensorProto.INT64),
        helper.make_node("Gather", ["table", "i"], ["y"]),
    ]
    file = onnx_models.saved(
        tmp_path / "m.onnx", {"x": ["n", 1]}, {"y": ["n", 1]}, nodes, {"table": np.float32([1, 2])}
    )
    drive = ModelDrive(a_detector(), a_rule("r", signals=[SPEED, risk(file, x(signals=["speed"]))], when="risk > 1"))
    assert drive.take(arrival(0.5, "car", {"v": 9}), until=1) == []
    counters = drive.engine.counters.rule("r")
    assert counters.errors == 1
    assert "signal risk: the model failed" in counters.last_error
    assert drive.take(arrival(1.5, "car", {"v": 1}), until=2) == ["r car started 2"]


def problems(tmp_path: Path, signal: dict[str, Any], detector: Detector | None = None) -> list[str]:
    rule = a_rule("r", signals=[SPEED, GAP, signal], when="true")
    (tmp_path / "d.json.yaml").write_text((detector or a_detector()).model_dump_json(by_alias=True, exclude_none=True))
    (tmp_path / "r.json.yaml").write_text(rule.model_dump_json(by_alias=True, exclude_none=True))
    return [str(problem) for problem in findings(load_documents([tmp_path])).problems]


@pytest.mark.parametrize(
    ("change", "where", "logged"),
    [
        ({"file": "/nowhere/m.onnx"}, "model.file", "cannot read /nowhere/m.onnx: No such file"),
        ({"file": __file__}, "model.file", "is not a valid ONNX model"),
        ({"sha256": "0" * 64}, "model.sha256", "of the file is"),
        (
            {"inputs": [{"name": "y", "signals": ["speed", "gap"]}]},
            "inputs[0].name",
            "no input y; its inputs are x [any, 2]",
        ),
        ({"inputs": [{"name": "y", "signals": ["speed", "gap"]}]}, "model.inputs", "the model also needs the inputs x"),
        ({"inputs": [x(signals=["speed"])]}, "inputs[0]", "the input of a client has shape [1], but x requires [2]"),
        ({"inputs": [x(signals=["speed", "gab"])]}, "signals[1]", "the rule has no signal gab; it has speed, gap"),
        ({"inputs": [x(signals=["speed", "risk"])]}, "signals[1]", "risk is computed by a model"),
        (
            {"inputs": [x(window={"signals": ["speed"], "over": "10s", "samples": 2})]},
            "window.over",
            "not shorter than",
        ),
        (
            {"inputs": [x(points={"stream": "speed", "count": 1})]},
            "points.stream",
            "must be sensor_msgs/msg/PointCloud2",
        ),
        ({"inputs": [x(image={"stream": "none", "width": 1, "height": 1})]}, "image.stream", "has no stream none"),
        ({"output": "riks"}, "model.output", "the model has no output riks; its outputs are risk [any, 1]"),
    ],
)
def test_a_mismatch_of_model_and_rule_is_reported_by_field(
    tmp_path: Path, change: dict[str, Any], where: str, logged: str
) -> None:
    file = onnx_models.weighted(tmp_path / "m.onnx", [1.0, 1.0])
    signal = risk(file, x(signals=["speed", "gap"]))
    signal["model"] |= change
    found = problems(tmp_path, signal)
    assert any(where in problem and logged in problem for problem in found), found


def test_models_with_unsupported_axes_inputs_or_outputs_are_rejected(tmp_path: Path) -> None:
    fixed = onnx_models.weighted(tmp_path / "fixed.onnx", [1.0, 1.0], clients=4)
    (problem,) = problems(tmp_path, risk(fixed, x(signals=["speed", "gap"])))
    assert "for exactly 4 clients: export the model with a first axis of variable length" in problem
    nodes = [helper.make_node("ReduceSum", ["x"], ["y"], keepdims=0)]
    total = onnx_models.saved(tmp_path / "total.onnx", {"x": ["n", 2]}, {"y": []}, nodes)
    (problem,) = problems(tmp_path, risk(total, x(signals=["speed", "gap"])))
    assert "output y has shape [] for two clients: its first axis must be the clients" in problem


def test_a_rule_with_another_model_is_another_rule(tmp_path: Path) -> None:
    file = onnx_models.weighted(tmp_path / "m.onnx", [1.0])
    detector = a_detector()
    rule = always(SPEED, risk(file, x(signals=["speed"])))
    index, fields = RuleIndex(), stream_readers(detector).fields
    drive = ModelDrive(detector, rule)
    drive.take(arrival(0.5, "car", {"v": 1}), until=1)
    assert drive.note(drive.engine.set_rules(index.compile([rule], detector, fields)[0])) == []
    onnx_models.weighted(file, [2.0])
    assert drive.note(drive.engine.set_rules(index.compile([rule], detector, fields)[0])) == ["r car RuleChanged 1"]


def test_the_same_samples_give_the_same_bytes(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    file = onnx_models.weighted(tmp_path / "m.onnx", [*rng.normal(size=8)])
    signal = risk(file, x(window={"signals": ["speed"], "last": 8}))

    def lines() -> list[str]:
        drive = ModelDrive(a_detector(), a_rule("r", signals=[SPEED, signal], when="risk > 0"))
        values = np.random.default_rng(3).normal(size=400)
        sent: list[Arrival] = [arrival(0.01 + n / 20, f"car{n % 5}", {"v": value}) for n, value in enumerate(values)]
        drive.take(*sent, until=20)
        return [event.to_json() for event in drive.events]

    first = lines()
    assert len(first) > 20
    assert lines() == first


def test_the_documentations_example_is_a_rule_that_runs(tmp_path: Path) -> None:
    spec = yaml.safe_load(yaml_blocks(guide("models"))[0])
    shapes = {"state": ["n", 2], "history": ["n", 20]}
    nodes = [
        helper.make_node("ReduceMean", ["state"], ["s"], axes=[1], keepdims=1),
        helper.make_node("ReduceMean", ["history"], ["h"], axes=[1], keepdims=1),
        helper.make_node("Add", ["s", "h"], ["risk"]),
    ]
    spec["signals"][2]["model"]["file"] = str(onnx_models.saved(tmp_path / "m.onnx", shapes, {"risk": ["n", 1]}, nodes))
    driven = ModelDrive(a_detector(a_stream("odometry"), a_stream("radar")), a_rule("r", **spec))
    twist = {"twist": {"twist": {"linear": {"x": 10}}}}
    sent = [arrival(0.01 * n, "car", twist, "odometry") for n in range(1, 30)]
    assert driven.take(*sent, arrival(0.5, "car", {"range": 4}, "radar"), until=1) == ["r car started 1"]
    assert driven.values()["risk"] == 17.0
