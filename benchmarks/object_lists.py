"""CPU time of object lists: how much of a core ten rules over the items of each message take, beside decoding alone.

One station sends lists of objects as JSON at 25 Hz; each object is a client of its own. Half of the rules look at
windows of an object, the others at its newest sample, and one is about pairs of objects near each other. Ids change: an
object is there for ten seconds, then another one has its place. The list comes in as it would live: one message a call,
rules due every 100 ms. The baseline, in the same rounds, decodes each message once and does no more.

    python -m benchmarks.object_lists [--objects 200] [--hz 25] [--seconds 20] [--repeat 3] [--cdr]

`--cdr` sends the objects as a ROS 2 message like vision_msgs/Detection3DArray instead. "Of a core" is CPU time divided
by the time of the data: below 0.33 a third of a core keeps up.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from detector.assembly import StreamReaders, make_engine, stream_readers
from detector.assembly.memory import tune_garbage_collection
from detector.engine.samples.sample import Arrival
from wayside.api import API_VERSION, Detector, EventRule
from wayside.rules import compile_rule

START = 1_767_225_600 * 10**9
SECOND = 10**9
STAY = 10.0
"""Seconds that an object is there."""

TYPE = "lab_msgs/msg/Objects"
MESSAGES = [
    {"name": TYPE, "definition": "std_msgs/Header header\nlab_msgs/Object[] objects"},
    {
        "name": "lab_msgs/msg/Object",
        "definition": "std_msgs/Header header\nuint32 id\nstring kind\nfloat64 score\n"
        "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\ngeometry_msgs/Vector3 size",
    },
]
X, Y, V = "item.pose.pose.position.x", "item.pose.pose.position.y", "item.twist.twist.linear.x"


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="object_lists", description=__doc__)
    parser.add_argument("--objects", type=int, default=200, help="in each message (%(default)s)")
    parser.add_argument("--hz", type=int, default=25, help="messages a second (%(default)s)")
    parser.add_argument("--seconds", type=float, default=20.0, help="of data (%(default)g)")
    parser.add_argument("--repeat", type=int, default=3, help="rounds (%(default)s)")
    parser.add_argument("--cdr", action="store_true", help="as CDR")
    options = parser.parse_args()
    detector = a_detector("cdr" if options.cdr else "json")
    readers, rules = stream_readers(detector), ten_rules()
    encode = cdr(readers) if options.cdr else as_json
    arrivals = [*sent(options.objects, options.hz, options.seconds, encode)]
    size = len(arrivals[0].payload)
    run(detector, readers, rules, arrivals[: options.hz])  # imports are done before it counts
    tune_garbage_collection()  # as a detector does
    decoding, evaluating, events = [], [], 0
    for _ in range(options.repeat):
        begin = time.process_time()
        for each in arrivals:
            readers.decoders["objects"].decode(each.payload)
        decoding.append(time.process_time() - begin)
        begin = time.process_time()
        events, inserting = run(detector, readers, rules, arrivals)
        evaluating.append(time.process_time() - begin)
    baseline, spent = (statistics.median(each) / options.seconds for each in (decoding, evaluating))
    print(
        f"{options.objects} objects at {options.hz} Hz ({size:,} bytes), {len(rules)} rules: {spent:.3f} of a core, "
        f"of which inserting the items {inserting / options.seconds:.3f}; decoding alone {baseline:.3f}: "
        f"{spent / baseline:.1f} times; {events} events"
    )
    return 0


def run(
    detector: Detector, readers: StreamReaders, rules: Sequence[EventRule], arrivals: Sequence[Arrival]
) -> tuple[int, float]:
    """The number of events, and the CPU time of the calls in which no tick was due."""
    engine = make_engine(detector, readers, holder="h", start=START)
    engine.set_rules([compile_rule(rule, detector, readers.fields) for rule in rules])
    events, inserting = 0, 0.0
    for each in arrivals:
        begin, tick = time.process_time(), engine.next_tick()
        events += len(engine.advance((each,), each.received))
        if each.received < tick:
            inserting += time.process_time() - begin
    return events, inserting


def a_detector(encoding: str) -> Detector:
    stream = {"name": "objects", "key": "stations/${station:*}/objects", "staleAfter": "1s"}
    of_type = {"type": TYPE} if encoding == "cdr" else {}
    items = {"encoding": encoding, "items": "msg.objects", "client": "${item.id}", **of_type}
    spec = {"streams": [{**stream, **items}], "messages": MESSAGES if encoding == "cdr" else []}
    return Detector.model_validate(
        {"apiVersion": API_VERSION, "kind": "Detector", "metadata": {"name": "d"}, "spec": spec}
    )


def ten_rules() -> list[EventRule]:
    windows = [
        (V, "Max", "s > 13"),
        (V, "Min", "s < 3"),
        (V, "Mean", "s > 9"),
        (V, "First", "s > 14"),
        (X, "Delta", "s > 12"),
    ]
    newest = [(V, "s > 14"), (V, "s < 1"), (f"{X} > 20 && {X} < 40 && {Y} < 10", "s"), ("item.kind == 'bike'", "s")]
    signals = [({"value": value, "over": "2s", "aggregate": aggregate}, when) for value, aggregate, when in windows]
    signals += [({"value": value}, when) for value, when in newest]
    specs = [{"signals": [{"name": "s", "stream": "objects", **signal}], "when": when} for signal, when in signals]
    position = {"stream": "objects", "x": X, "y": Y}
    specs.append({"scope": {"pairs": {"position": position, "within": 3}}, "when": "distance < 1"})
    return [
        EventRule.model_validate(
            {
                "apiVersion": API_VERSION,
                "kind": "EventRule",
                "metadata": {"name": f"r{number}"},
                "spec": {**spec, "evaluation": {"every": "100ms"}},
            }
        )
        for number, spec in enumerate(specs)
    ]


def sent(objects: int, hz: int, seconds: float, encode: Callable[[float, list[Any]], bytes]) -> Iterator[Arrival]:
    """The messages of a station, all in one key."""
    for number in range(round(hz * seconds)):
        now = number / hz + 0.001
        found = []
        for place in range(objects):
            begin = now + place * STAY / objects
            phase = begin % STAY
            v = 8 + 7 * math.sin(begin + place)
            found.append((int(begin // STAY) * objects + place, place % 20 * 4 + phase, place // 20 * 4.0, v))
        yield Arrival(START + round(now * SECOND), "objects", "stations/n/objects", encode(now, found))


def as_json(now: float, found: list[tuple[int, float, float, float]]) -> bytes:
    objects = [
        {
            "id": number,
            "kind": "bike" if number % 5 == 0 else "car",
            "score": 0.9,
            "pose": {"pose": {"position": {"x": x, "y": y, "z": 0.0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}},
            "twist": {"twist": {"linear": {"x": v, "y": 0.0, "z": 0.0}}},
            "size": {"x": 4.2, "y": 1.8, "z": 1.5},
        }
        for number, x, y, v in found
    ]
    return json.dumps({"header": {"stamp": now, "frame_id": "map"}, "objects": objects}).encode()


def cdr(readers: StreamReaders) -> Callable[[float, list[Any]], bytes]:
    """Encodes the same as the message of ROS 2."""
    store = readers.types.store
    types = store.types
    vector, point = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Point"]
    none, covariance = vector(x=0.0, y=0.0, z=0.0), np.zeros(36)
    straight = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)

    def header(now: float) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](sec=int(now), nanosec=int(now % 1 * 1e9))
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="map")

    def item(now: float, number: int, x: float, y: float, v: float) -> Any:
        pose = types["geometry_msgs/msg/Pose"](position=point(x=x, y=y, z=0.0), orientation=straight)
        twist = types["geometry_msgs/msg/Twist"](linear=vector(x=v, y=0.0, z=0.0), angular=none)
        return types["lab_msgs/msg/Object"](
            header=header(now),
            id=number,
            kind="bike" if number % 5 == 0 else "car",
            score=0.9,
            pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=covariance),
            twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=covariance),
            size=none,
        )

    def encode(now: float, found: list[Any]) -> bytes:
        message = types[TYPE](header=header(now), objects=[item(now, *each) for each in found])
        return bytes(store.serialize_cdr(message, TYPE))

    return encode


if __name__ == "__main__":
    sys.exit(main())
