"""The cost of recording: the record action against a bare MCAP writer, and the effect on the evaluation.

    python benchmarks/recording.py [--megabytes 400] [--folder DIR]           # writes; both on the same disk
    python benchmarks/recording.py --latency [--rate 200] [--seconds 10]      # a detector process, clouds over Zenoh

Writes: 1 MB point clouds, without compression, written alternately by the record action and by `mcap.writer.Writer`,
each until the disk has them (fsync). The claim is a ratio of 0.8 or more.

Latency: a detector takes in clouds of 1 MB at `--rate` per second all the time, and records them in every other phase.
Meanwhile a small message makes a rule start and end; the time from sending it to receiving the event is compared
between the phases, with the same load of clouds in both.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import tempfile
import threading
import time
from pathlib import Path

import zenoh
from mcap.writer import CompressionType, Writer

from detector.actions.episode import Completion, EpisodeSample
from detector.streams.codecs.ros import standard
from tests.driving import a_rule, a_stream, at
from tests.process.running import Process
from tests.recording_bench import Bench, an_episode
from tests.ros_messages import cdr, point_cloud

POINTS = a_stream("points", encoding="cdr", type="sensor_msgs/msg/PointCloud2")
CLOUD = cdr(point_cloud(83_000))
_BATCH = 10


def clouds(number: int) -> list[EpisodeSample]:
    """Samples with separate payloads, as received from the network."""
    return [
        EpisodeSample(
            "car1", "points", "vehicles/car1/points", at(1 + k / 200), at(1 + k / 200), bytes(bytearray(CLOUD))
        )
        for k in range(number)
    ]


def by_action(folder: Path, samples: list[EpisodeSample]) -> float:
    bench = Bench(folder, POINTS)
    episode = an_episode()
    begin = time.perf_counter()
    bench.action.started(episode)
    for first in range(0, len(samples), _BATCH):
        bench.action.samples(episode, samples[first : first + _BATCH])
    bench.action.completed(episode, Completion())
    taken = time.perf_counter() - begin
    assert bench.outcome(episode).samples == len(samples), bench.outcome(episode)
    return taken


def by_bare_writer(folder: Path, samples: list[EpisodeSample]) -> float:
    folder.mkdir()
    definition = standard().definition("sensor_msgs/msg/PointCloud2").encode()
    begin = time.perf_counter()
    with (folder / "bare.mcap").open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("ros2")
        schema = writer.register_schema("sensor_msgs/msg/PointCloud2", "ros2msg", definition)
        channel = writer.register_channel("/vehicles/car1/points", "cdr", schema)
        for sample in samples:
            writer.add_message(channel, sample.time, sample.payload, sample.time)
        writer.finish()  # type: ignore[no-untyped-call]
        file.flush()
        os.fsync(file.fileno())
    return time.perf_counter() - begin


def writes(megabytes: int, parent: Path | None, rounds: int = 5) -> None:
    ratios, rates = [], []
    samples = clouds(megabytes)
    size = sum(len(sample.payload) for sample in samples) / 1e6
    for number in range(rounds + 1):
        with tempfile.TemporaryDirectory(dir=parent) as folder:
            order = (by_action, by_bare_writer) if number % 2 else (by_bare_writer, by_action)
            times = {}
            for write in order:
                where = Path(folder) / write.__name__
                times[write] = write(where, samples)
                shutil.rmtree(where)
        if number:  # the first is for warming up
            ratios.append(times[by_bare_writer] / times[by_action])
            rates.append((size / times[by_action], size / times[by_bare_writer]))
            print(f"record {rates[-1][0]:7.0f} MB/s   bare writer {rates[-1][1]:7.0f} MB/s   ratio {ratios[-1]:.2f}")
    print(f"median ratio {statistics.median(ratios):.2f} (claim: 0.8 or more)")


PROBE = a_rule(
    "probe",
    signals=[{"name": "v", "stream": "speed", "value": "msg.v"}],
    when="v > 0",
    evaluation={"every": "20ms"},
)
KEEP = a_rule(
    "keep",
    signals=[{"name": "on", "stream": "phase", "value": "msg.on"}],
    when="on > 0",
    evaluation={"every": "100ms"},
    actions=[{"name": "bag", "record": {"streams": ["points"]}}],
)


class Clouds(threading.Thread):
    """Publishes clouds at a rate."""

    def __init__(self, session: zenoh.Session, rate: float) -> None:
        super().__init__(daemon=True)
        self._session, self._rate = session, rate
        self.sent = 0
        self.stop = threading.Event()

    def run(self) -> None:
        begin = time.perf_counter()
        publisher = self._session.declare_publisher(
            "vehicles/car1/points", congestion_control=zenoh.CongestionControl.BLOCK
        )
        while not self.stop.is_set():
            time.sleep(max(0.0, begin + self.sent / self._rate - time.perf_counter()))
            publisher.put(CLOUD)
            self.sent += 1


def latency(rate: float, seconds: float, parent: Path | None, phases: int = 6) -> None:
    with tempfile.TemporaryDirectory(dir=parent) as folder:
        process = Process(Path(folder))
        streams = (POINTS, a_stream("speed"), a_stream("phase"))
        recordings = {"path": "recordings", "bytes": "8Gi"}
        buffer = {"duration": "1s", "bytes": "1Gi"}
        process.write(PROBE, KEEP, streams=streams, recordings=recordings, buffer=buffer)
        process.start()
        arrived = threading.Event()
        process.vehicle.declare_subscriber("wayside/events/d/probe/**", lambda sample: arrived.set())
        found: dict[bool, list[float]] = {True: [], False: []}
        load = Clouds(process.vehicle, rate)
        load.start()
        value = 0
        for phase in range(phases):
            recording = phase % 2 == 1
            process.send("car1", {"on": int(recording)}, "phase")
            time.sleep(1)
            until, sent, began = time.perf_counter() + seconds, load.sent, time.perf_counter()
            while time.perf_counter() < until:
                value = 1 - value
                arrived.clear()
                start = time.perf_counter()
                process.send("car1", {"v": value})
                if arrived.wait(10):
                    found[recording].append(time.perf_counter() - start)
                time.sleep(0.013)
            reached = (load.sent - sent) / (time.perf_counter() - began) * len(CLOUD) / 1e6
            print(f"{'recording' if recording else 'without  '} {reached:6.0f} MB/s of clouds", flush=True)
        load.stop.set()
        load.join()
        process.send("car1", {"on": 0}, "phase")
        status = process.status_when(lambda status: all(not each.running for each in status.actions))
        for each in status.actions:
            print(
                f"recorded {each.done} times, failed {each.failed}: {each.bytes / 1e6:.0f} MB, missing {each.missing}"
            )
        process.stop()
    for recording, times in found.items():
        cuts = statistics.quantiles(times, n=100)
        print(
            f"{'recording' if recording else 'without  '} message to event: median {cuts[49] * 1e3:6.1f} ms   "
            f"90 % {cuts[89] * 1e3:6.1f} ms   99 % {cuts[98] * 1e3:6.1f} ms   ({len(times)} events)"
        )
    print(f"ratio of the medians {statistics.median(found[True]) / statistics.median(found[False]):.2f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megabytes", type=int, default=400)
    parser.add_argument("--folder", type=Path, help="on the disk that is to be measured")
    parser.add_argument("--latency", action="store_true")
    parser.add_argument("--rate", type=float, default=200.0, help="clouds a second")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each phase")
    given = parser.parse_args()
    if given.latency:
        latency(given.rate, given.seconds, given.folder)
    else:
        writes(given.megabytes, given.folder)
