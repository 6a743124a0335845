"""The database action is at most a fifth slower than bare pymongo bulk inserts of the same documents.

Both write to the same server, round about, each round into fresh collections. The action begins with the messages as
they were received: decoding, conversion and its queue are part of what is measured. The baseline inserts the documents
that the action makes, as maps in memory, with `insert_many(ordered=False)` in thousands, and with the same index.

    python -m benchmarks.database_insert [--samples N] [--rounds N]
"""

from __future__ import annotations

import argparse
import os
import statistics
import threading
import time
import uuid
from typing import Any

import bson
import numpy as np
import pymongo
from msgspec.structs import replace

from detector.actions import (
    ActionContext,
    Completion,
    DetectorConfiguration,
    Episode,
    EpisodeSample,
    Outcome,
    OutcomeState,
)
from detector.actions.database import Database
from detector.actions.database.documents import Documents
from detector.assembly import stream_readers
from detector.streams.codecs.ros import standard
from tests.mongodb import MongoServer, running
from wayside.api import Detector, EventRule
from wayside.api.actions.database import DatabaseAction

START = 1_767_225_600 * 10**9
TARGET = 0.8
STREAMS = (
    {"name": "odom", "key": "v/${client:*}/odom", "encoding": "cdr", "type": "nav_msgs/msg/Odometry"},
    {"name": "json", "key": "v/${client:*}/json", "encoding": "json"},
)


def the_samples(count: int) -> list[EpisodeSample]:
    """Odometry as ROS 2 sends it, and every tenth a JSON message of about the same size."""
    store = standard().store
    types = store.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](START // 10**9, 5), "map")
    point, turn, vector = (types[f"geometry_msgs/msg/{name}"] for name in ("Point", "Quaternion", "Vector3"))
    samples = []
    for number in range(count):
        at = START + number * 10_000_000
        if number % 10 == 9:
            text = b'{"t": %d, "objects": [{"id": 1, "x": 1.5, "y": 2.5, "speed": 13.9, "kind": "car"}]}' % number
            samples.append(EpisodeSample("car1", "json", "v/car1/json", at, at, text))
            continue
        pose = types["geometry_msgs/msg/Pose"](point(number * 0.1, 2.0, 3.0), turn(0.0, 0.0, 0.0, 1.0))
        twist = types["geometry_msgs/msg/Twist"](vector(12.5, 0.0, 0.0), vector(0.0, 0.0, 0.1))
        covariance = np.zeros(36)
        message = types["nav_msgs/msg/Odometry"](
            header,
            "base",
            types["geometry_msgs/msg/PoseWithCovariance"](pose, covariance),
            types["geometry_msgs/msg/TwistWithCovariance"](twist, covariance),
        )
        payload = bytes(store.serialize_cdr(message, "nav_msgs/msg/Odometry"))
        samples.append(EpisodeSample("car1", "odom", "v/car1/odom", at, at, payload))
    return samples


class NoMessenger:
    """A messenger without Zenoh."""

    def publish(self, *_: Any) -> None:
        raise AssertionError

    def query(self, *_: Any) -> list[bytes]:
        raise AssertionError


def with_the_action(detector: Detector, samples: list[EpisodeSample], name: str) -> float:
    """Seconds from the first sample until the scenario is complete in the database."""
    rule = EventRule.model_validate(
        {"kind": "EventRule", "metadata": {"name": "bench"}, "spec": {"when": "true", "actions": []}}
    )
    readers = stream_readers(detector)
    configuration = DetectorConfiguration(detector, readers.decoders, readers.types)
    done = threading.Event()
    reported: list[Outcome] = []

    def report(episode: Episode, outcome: Outcome) -> None:
        reported.append(outcome)
        if outcome.state is not OutcomeState.RUNNING:
            done.set()

    def lose(what: str, count: int, why: str) -> None:
        raise AssertionError(f"{count} {what} lost: {why}")

    context = ActionContext(rule, "keep", "h", lambda: configuration, NoMessenger(), report, lose, threading.Event())
    action = Database(DatabaseAction(database=name), context)
    action.wake()
    episode = Episode(
        "e", "bench", "car1", ("car1",), None, START, START, {}, None, rendered={}, unrendered={}, started={}
    )
    begin = time.perf_counter()
    action.started(episode)
    for first in range(0, len(samples), 100):  # as the host passes them on
        action.samples(episode, samples[first : first + 100])
        action.wake()
    action.completed(replace(episode, end_time=START, reason="Until"), Completion())
    done.wait()
    taken = time.perf_counter() - begin
    action.close()
    assert reported[-1].state is OutcomeState.DONE, reported[-1]
    return taken


def bare(uri: str, documents: dict[str, list[dict[str, Any]]], name: str) -> float:
    """Seconds that pymongo takes for the same documents."""
    with pymongo.MongoClient[dict[str, Any]](uri) as client:
        database = client.get_database(name, write_concern=pymongo.WriteConcern("majority"))
        begin = time.perf_counter()
        for collection, content in documents.items():
            database[collection].create_index("scenario")
            for first in range(0, len(content), 1000):
                database[collection].insert_many(content[first : first + 1000], ordered=False)
        return time.perf_counter() - begin


def run(server: MongoServer, count: int, rounds: int) -> float:
    os.environ["WAYSIDE_BENCH_URI"] = server.uri
    spec = {"streams": list(STREAMS), "database": {"uriVariable": "WAYSIDE_BENCH_URI"}}
    detector = Detector.model_validate({"kind": "Detector", "metadata": {"name": "d"}, "spec": spec})
    samples = the_samples(count)
    readers = stream_readers(detector)
    maker = Documents("e.keep", "", {stream.name: stream for stream in detector.spec.streams}, readers.decoders, None)
    documents: dict[str, list[dict[str, Any]]] = {}
    for sample in samples:
        converted = maker.make(sample)
        documents.setdefault(converted.collection, []).append(bson.decode(converted.document))
    begin = time.process_time()
    for sample in samples:
        maker.make(sample)
    print(f"decoding and conversion alone: {count / (time.process_time() - begin):,.0f} documents/s of one core")
    size = sum(len(bson.encode(each)) for content in documents.values() for each in content)
    print(f"{server.kind}: {count} documents of {size / count:.0f} bytes on average")
    ratios = []
    with pymongo.MongoClient[dict[str, Any]](server.uri) as client:
        for number in range(rounds):
            ours, theirs = (f"bench{uuid.uuid4().hex[:12]}" for _ in range(2))
            if number % 2:
                b, a = bare(server.uri, documents, theirs), with_the_action(detector, samples, ours)
            else:
                a, b = with_the_action(detector, samples, ours), bare(server.uri, documents, theirs)
            assert all(
                client[ours][name].count_documents({}) == client[theirs][name].count_documents({}) == len(content)
                for name, content in documents.items()
            )
            ratios.append(b / a)
            print(f"action {count / a:8,.0f} documents/s, bare pymongo {count / b:8,.0f}: {b / a:.2f}")
            client.drop_database(ours)
            client.drop_database(theirs)
    return statistics.median(ratios)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--samples", type=int, default=10_000)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    with running() as server:
        ratio = run(server, options.samples, options.rounds)
    print(f"median: {ratio:.2f} of bare pymongo (target {TARGET})")
    return 0 if ratio >= TARGET else 1


if __name__ == "__main__":
    raise SystemExit(main())
