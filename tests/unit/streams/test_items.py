"""Object lists: `items` of a stream makes each item of a message a sample of a client of its own."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import cbor2
import numpy as np
import pytest
import yaml

from detector.assembly import DetectorError, stream_readers
from detector.engine.consequences import RunSamples
from detector.engine.samples.sample import Arrival
from detector.replay.replaying import replay_intake
from detector.streams.codecs.definitions import Definition
from detector.streams.codecs.etsi import EtsiDecoder, OwnDefinitions
from detector.streams.codecs.ros import types_with
from tests.driving import Drive, a_detector, a_rule, a_stream, at, lines
from tests.guides import guide, yaml_blocks
from tests.patience import PATIENCE
from tests.unit.encodings.test_etsi_asn1 import DICTIONARY, PERCEPTION, perception
from tests.unit.engine.live import Live
from wayside.api import Detector, EventRule
from wayside.rules import RuleError, compile_rule

FAST = a_rule(
    "fast",
    signals=[{"name": "v", "stream": "list", "value": "item.v", "over": "5s", "aggregate": "Max"}],
    when="v > 10",
    evaluation={"every": "100ms"},
)
NEAR = a_rule(
    "near",
    scope={"pairs": {"position": {"stream": "list", "x": "item.x", "y": "item.y"}, "within": 5}},
    when="distance < 2",
    evaluation={"every": "100ms"},
)


def a_list(items: str = "msg.objects", client: str = "${item.id}", **fields: Any) -> dict[str, Any]:
    key = "stations/${station:*}/list"
    return {"name": "list", "key": key, "encoding": "json", "items": items, "client": client, **fields}


def item(name: Any, x: float = 0.0, v: float = 1.0) -> dict[str, Any]:
    return {"id": name, "x": x, "y": 0.0, "v": v}


def sent(seconds: float, *items: Any, **fields: Any) -> Arrival:
    payload = json.dumps({"t": at(seconds) / 1e9, "objects": items, **fields}).encode()
    return Arrival(at(seconds), "list", "stations/n/list", payload)


@pytest.mark.parametrize("clock", ["Wall", "Data"])
def test_each_item_is_a_sample_of_its_own_client(clock: str) -> None:
    stamp = {"stamp": "msg.t"} if clock == "Data" else {}
    drive = Drive(a_detector(a_list(**stamp), clock=clock, lateness="0ms"), FAST, NEAR)
    assert drive.engine.in_columns == {"fast", "near"}
    events = drive.take(
        sent(0.05, item(1, 0), item(2, 9), item("bus", 50)),
        sent(0.15, item(1, 4), item(2, 5, v=20)),
        sent(0.25, item(1, 30), item("bus", 50, v=20)),
        sent(0.45),
        until=0.4,
    )
    events += drive.finish()
    assert events == ["fast 2 started 0.2", "near 1+2 started 0.2", "fast bus started 0.3", "near 1+2 Until 0.3"]
    assert drive.engine.counters.samples["list"] == 4


def test_expressions_see_the_item_the_message_and_the_captures_of_its_key() -> None:
    stream = a_list(client="${key.station}-${item.id}", stamp="msg.t")
    rule = a_rule(
        signals=[
            {"name": "v", "stream": "list", "value": "item.v * msg.scale"},
            {"name": "whole", "stream": "list", "value": "size(msg.objects) + size(item)"},
            {"name": "late", "stream": "list", "value": "sample.latency", "where": "item.v > 1"},
        ],
        when="v > 10 && whole == 6 && late >= 0",
        evaluation={"onSample": "list"},
    )
    drive = Drive(a_detector(stream), rule)
    assert drive.take(sent(0.5, item(1), item(2, v=6), scale=2), until=1) == ["r n-2 started 0.5"]


def test_an_item_client_is_lost_when_stale_and_its_name_becomes_a_new_client() -> None:
    drive = Drive(a_detector(a_list(staleAfter="2s"), a_stream("speed")), FAST)
    vehicle = Arrival(at(0.1), "speed", "vehicles/2/speed", b"{}")
    assert drive.take(vehicle, sent(0.5, item(1, v=20), item(2, v=20)), until=1) == [
        "fast 1 started 0.5",
        "fast 2 started 0.5",
    ]
    # Client 2 sends on a stream without items as well: it is known until clientTimeout.
    assert drive.take(until=4) == ["fast 1 ClientLost 2.6"]
    assert drive.take(sent(4.0, item(1)), until=5) == []  # the window of 5 s does not hold the 20 of the other
    assert drive.take(sent(5.1, item(1, v=11)), until=5.2) == ["fast 1 started 5.1"]
    drive.take(until=20)
    assert [*drive.engine.clients] == ["2"]


def test_items_without_a_valid_name_are_dropped_and_counted_with_the_reason() -> None:
    drive = Drive(a_detector(a_list()), FAST)
    counters = drive.engine.counters
    drive.take(sent(0.1, item(1), {"x": 1}), until=0.2)
    assert counters.unnamed["list"] == 1
    assert "stations/n/list: client: " in counters.last_unnamed["list"]
    assert "there is no `item.id`" in counters.last_unnamed["list"]
    drive.take(sent(0.3, item(1), item(1, v=20)), until=0.4)
    assert counters.last_unnamed["list"].endswith("client: two items of one message have the name 1")
    drive.take(Arrival(at(0.5), "list", "stations/n/list", b'{"objects": 3}'), until=0.6)
    assert counters.last_unnamed["list"] == "stations/n/list: items: must be a list; got a number"
    drive.take(Arrival(at(0.7), "list", "stations/n/list", b'{"others": []}'), until=0.8)
    assert counters.last_unnamed["list"] == "stations/n/list: items: there is no `msg.objects`"
    drive.take(Arrival(at(0.9), "list", "stations/n/list", b"no json"), until=1)
    assert (counters.unnamed["list"], counters.undecodable["list"]) == (4, 1)
    assert drive.events == []


def test_items_beyond_the_bounds_are_dropped_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("detector.engine.buffering.ingest.MAXIMUM_OBJECTS", 3)
    monkeypatch.setattr("detector.engine.buffering.naming.MAXIMUM_ITEMS", 4)
    drive = Drive(a_detector(a_list(), a_stream("speed")), FAST)
    drive.take(sent(0.1, *map(item, range(6))), until=0.2)
    assert [*drive.engine.clients] == ["0", "1", "2"]
    assert drive.engine.counters.crowded["list"] == 3
    drive.take(Arrival(at(0.3), "speed", "vehicles/car/speed", b"{}"), until=0.4)
    assert "car" in drive.engine.clients
    drive.take(*(sent(seconds, item(9, v=20)) for seconds in (6, 7, 8)), until=9)
    assert "9" in drive.engine.clients


def test_the_items_of_a_message_share_its_place_in_the_buffer() -> None:
    drive = Drive(a_detector(a_list(staleAfter="2s")), FAST)
    drive.take(sent(0.5, *map(item, range(100))), until=0.9)
    payload = len(sent(0.5, *map(item, range(100))).payload)
    assert payload <= drive.engine.buffer.bytes - 100 * 160 + 100 <= payload + 100
    drive.take(until=10)
    assert drive.engine.buffer.bytes == 0


def test_an_action_gets_the_message_once_for_all_its_items() -> None:
    action = {"name": "keep", "plugin": {"name": "keeper", "window": {"before": "1s", "after": "300ms"}}}
    every = {"name": "all", "plugin": {"name": "keeper", "window": {"before": "1s", "clients": "All"}}}
    near = NEAR.model_copy(update={"spec": a_rule(**NEAR.spec.to_json() | {"actions": [action, every]}).spec})
    drive = Drive(a_detector(a_list()), near)
    drive.engine.consequences.wanted = True
    arrivals = [sent(n / 10 + 0.05, item(1), item(2, 1 if n < 10 else 9), item(3, 90)) for n in range(20)]
    drive.take(*arrivals, until=3)
    found = drive.engine.consequences.drain(drive.engine.now)
    samples: dict[str, list[Any]] = {}
    for each in found:
        if isinstance(each, RunSamples):
            samples.setdefault(each.run.action, []).extend(each.samples)
    of_pair = [each.payload for each in samples["keep"]]
    assert of_pair == [each.payload for each in arrivals[:14]]  # up to 0.3 s after its end at 1.1 s
    assert {each.client for each in samples["keep"]} == {"1"}
    assert [each.payload for each in samples["all"]] == [each.payload for each in arrivals[:11]]


def test_live_and_replay_give_the_same_events() -> None:
    live = Live(
        a_detector(a_list(staleAfter="1s")), [FAST, NEAR, a_rule("ask", when="true", evaluation={"onDemand": True})]
    )
    put = live.intake.putter("list")
    for n in range(120):
        live.now += 50_000_000
        items = [item(1, n % 7, n % 13), item(2, 3, n % 11), *([item(3, 9, 12)] if n % 40 < 5 else [])]
        put([("stations/n/list", sent(0, *items).payload)])
        if n % 7 == 0:
            live.evaluator.evaluate_rule("ask").result(PATIENCE)
    recording = live.stop()
    assert {event.episode.subject for event in recording.logged} >= {"1", "2", "3", "1+2"}
    assert {str(event.reason) for event in recording.logged} >= {"ClientLost", "Until"}
    assert lines(replay_intake(recording.records, None, None).events) == lines(recording.logged)


OBJECTS = "std_msgs/Header header\nlab_msgs/Track[] objects\ngeometry_msgs/Pose origin\nfloat64[] scores"
TRACK = "uint32 id\ngeometry_msgs/PoseWithCovariance pose\nfloat64 v\nstring[] labels"
MESSAGES = [
    {"name": "lab_msgs/msg/Tracks", "definition": OBJECTS},
    {"name": "lab_msgs/msg/Track", "definition": TRACK},
]


def of_type(items: str = "msg.objects", client: str = "track-${item.id}") -> dict[str, Any]:
    return a_list(items, client, encoding="cdr", type="lab_msgs/msg/Tracks")


def tracks(*places: tuple[int, float]) -> bytes:
    """A message of ROS 2 with these objects."""
    store = types_with(tuple(Definition(each["name"], each["definition"]) for each in MESSAGES)).store
    make = store.types
    zero = {"orientation": make["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)}

    def pose(x: float) -> Any:
        return make["geometry_msgs/msg/Pose"](position=make["geometry_msgs/msg/Point"](x=x, y=0.0, z=0.0), **zero)

    def track(number: int, x: float) -> Any:
        whole = make["geometry_msgs/msg/PoseWithCovariance"](pose=pose(x), covariance=np.zeros(36))
        return make["lab_msgs/msg/Track"](id=number, pose=whole, v=2.0 * x, labels=["car"])

    stamp = make["builtin_interfaces/msg/Time"](sec=5, nanosec=0)
    message = make["lab_msgs/msg/Tracks"](
        header=make["std_msgs/msg/Header"](stamp=stamp, frame_id="map"),
        objects=[track(*each) for each in places],
        origin=pose(0.0),
        scores=np.zeros(2),
    )
    return bytes(store.serialize_cdr(message, "lab_msgs/msg/Tracks"))


@pytest.mark.parametrize(
    ("stream", "payload", "value"),
    [
        (a_list(encoding="cbor"), cbor2.dumps({"objects": [item(1, 3.0), item(2, 9.0)]}), "item.x"),
        (a_list("msg", "o${item[0]}"), b"[[1, 3.0], [2, 9.0]]", "item[1]"),
        (a_list("msg.parts[1].list"), b'{"parts": [0, {"list": [{"id": "o1", "x": 3}, {"id": 2, "x": 9}]}]}', "item.x"),
        (
            a_list("msg.parts.filter(p, p.kind == 5)[0].list"),
            b'{"parts": [{"kind": 1}, {"kind": 5, "list": [{"id": 1, "x": 3}, {"id": 2, "x": 9}]}]}',
            "item.x",
        ),
        (of_type(), tracks((1, 3.0), (2, 9.0)), "item.pose.pose.position.x"),
        (of_type(), tracks((1, 3.0), (2, 9.0)), "item.v / 2"),
        (of_type(), tracks((1, 3.0), (2, 9.0)), "item.labels[0] == 'car' ? item.v / 2 : 0"),
    ],
)
def test_items_are_read_from_every_encoding(stream: Mapping[str, Any], payload: bytes, value: str) -> None:
    rule = a_rule(signals=[{"name": "x", "stream": "list", "value": value}], when="x > 5")
    drive = Drive(a_detector(stream, messages=MESSAGES), rule)
    (reported,) = drive.take(Arrival(at(0.5), "list", "stations/n/list", payload), until=1)
    assert reported.split()[1][-1] == "2"
    assert drive.events[0].values["x"] == 9.0


@pytest.mark.parametrize(
    ("stream", "problem"),
    [
        ({**a_list(), "client": "north"}, "items needs client, a template that names the client of each item"),
        (a_list(latched=True), "items is not valid for latched streams: remove items or latched"),
    ],
)
def test_items_need_a_client_of_each(stream: Mapping[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        a_detector(stream)


@pytest.mark.parametrize(
    ("stream", "problem"),
    [
        (a_list("msg.objects >"), r"items: line 1, column \d+: "),
        (a_list("msg.count > 1"), r"items: line 1, column 1: must be a list; got a boolean"),
        (a_list("item.objects"), r"items: line 1, column 1: `item` is not declared here"),
        (a_list(client="${msg.id}"), r"client: each item needs its own client: use item, e.g. \$\{item.id\}"),
        (of_type("msg.object"), r"items: msg has no field object; did you mean objects\?"),
        (of_type("msg.origin"), r"items: msg.origin is not a list: name a field that holds a list"),
        (of_type(client="${item.name}"), r"client: item has no field name; it has id, labels, pose, v"),
        (
            {**a_list(), "items": None, "client": "${item.id}"},
            r"client: .*`item` is not declared here.*; item is for streams with items: add items",
        ),
    ],
)
def test_errors_of_items_are_reported_by_field(stream: Mapping[str, Any], problem: str) -> None:
    with pytest.raises(DetectorError, match=r"spec.streams\[0\]\." + problem):
        stream_readers(a_detector(stream, messages=MESSAGES))


def of(value: str, stream: str = "list") -> Sequence[dict[str, Any]]:
    return [{"name": "s", "stream": stream, "value": value}]


@pytest.mark.parametrize(
    ("rule", "problem"),
    [
        (
            a_rule(signals=of("item.v", "speed"), when="s > 1"),
            r"signals\[0\].value: .*`item` is not declared here.*; item is for signals over streams with items",
        ),
        (a_rule(signals=of("item.w"), when="s > 1"), r"signals\[0\].value: item has no field w; .*\(stream list"),
        (
            a_rule(signals=of("msg.objects.v"), when="s > 1"),
            r"signals\[0\].value: msg.objects is a list and has no field v; read an item, e.g. msg.objects\[0\].v",
        ),
        (a_rule(signals=of("msg.objects[0].w"), when="s > 1"), r"signals\[0\].value: msg.objects.0 has no field w"),
        (
            a_rule(signals=of("item.v"), when="s > 1", each={"as": "item", "of": [{"name": "n"}]}),
            r"each.as: a sample already defines the variable item: the item of the message's list",
        ),
    ],
)
def test_errors_of_expressions_over_items_are_reported_by_field(rule: Any, problem: str) -> None:
    detector = a_detector(of_type(), a_stream("speed"), messages=MESSAGES)
    with pytest.raises(RuleError, match=problem):
        compile_rule(rule, detector, stream_readers(detector).fields)


def test_the_example_of_the_guide_finds_two_kinds_of_objects_that_collide() -> None:
    (block,) = [each for each in yaml_blocks(guide("encodings")) if "items:" in each]
    detector, rule = yaml.safe_load_all(block)
    drive = Drive(Detector.model_validate(detector), EventRule.model_validate(rule))

    def message(seconds: float, x: float) -> Arrival:
        objects = [{"id": 1, "x": x, "y": 0, "kind": "car"}, {"id": 2, "x": 9, "y": 0, "kind": "bicycle"}]
        payload = json.dumps({"objects": [*objects, {**objects[0], "id": 3}]}).encode()
        return Arrival(at(seconds), "objects", "stations/north/objects", payload)

    events = drive.take(*(message(n / 10 + 0.01, n) for n in range(20)), until=2)
    assert events == [
        "objects-collide north-1+north-2 started 0.9",
        "objects-collide north-2+north-3 started 0.9",
        "objects-collide north-1+north-2 Until 1.2",
        "objects-collide north-2+north-3 Until 1.2",
    ]


def test_the_objects_of_a_collective_perception_message_are_clients() -> None:
    decoder = EtsiDecoder("etsi/cpm", OwnDefinitions((PERCEPTION, DICTIONARY)))
    stream = a_list("msg.payload.parts", "${msg.header.stationId}.${item.partId}", encoding="uper", type="etsi/cpm")
    stream["key"] = "etsi/cpm"
    detector = a_detector(stream, asn1=[{"definition": PERCEPTION}, {"definition": DICTIONARY}])
    rule = a_rule(
        signals=[{"name": "length", "stream": "list", "value": "item.partData.length"}],
        when="length > 4",
        evaluation={"onSample": "list"},
    )
    drive = Drive(detector, rule)
    assert decoder.decode(perception())["payload"]["parts"][0]["partData"] == {"length": 4.5}
    assert drive.take(Arrival(at(0.5), "list", "etsi/cpm", perception()), until=1) == ["r 7.1 started 0.5"]
    assert [*drive.engine.clients] == ["7.1", "7.5", "7.9"]
