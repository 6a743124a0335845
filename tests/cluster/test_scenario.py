"""The whole chain live: vehicles on real Zenoh, both programs as processes, a real API server.

What exists over time is compared with what the simulated positions alone say should exist
(`cooperative_recording.expected`, which shares no code with either program).
"""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from tests.cluster.api import Api
from tests.cluster.processes import Processes
from tests.cluster.waiting import wait_until

EXAMPLE = Path(__file__).parents[2] / "examples" / "cooperative-recording"
sys.path.insert(0, str(EXAMPLE))

from cooperative_recording.expected import LINGER, episodes, fusions, recorders  # noqa: E402  the example is no package
from cooperative_recording.vehicles import simulate  # noqa: E402

SEED, DURATION = 3528, 25.0
EVALUATION = 0.5  # s, of the example's rule
ALLOWED = EVALUATION + 2.0
SAMPLING = 0.2  # s: a pose is up to 0.1 s old, and so is what the observer saw


@dataclass
class Seen:
    """What existed at one moment, in seconds into the drive."""

    at: float
    pairs: frozenset[tuple[str, ...]]
    sources: dict[str, tuple[str, ...]]


@dataclass
class Observer:
    """Looks at the Deployments and ConfigMaps of a namespace ten times a second."""

    api: Api
    start_ns: int
    seen: list[Seen] = field(default_factory=list)

    @contextmanager
    def watching(self) -> Iterator[None]:
        ended = threading.Event()
        thread = threading.Thread(target=self._run, args=(ended,), daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def _run(self, ended: threading.Event) -> None:
        while not ended.wait(0.1):
            before = time.time_ns()
            deployments = self.api.list("Deployment")
            configurations = {each["metadata"]["name"]: each for each in self.api.list("ConfigMap")}
            pairs = {_vehicles(each) for each in deployments if each["metadata"]["name"].startswith("scene-recorder")}
            sources = {}
            for each in deployments:
                found = configurations.get(f"{each['metadata']['name']}-sources")
                if found is not None:
                    content = yaml.safe_load(found["data"]["sources.yaml"])
                    sources[content["place"]] = tuple(content["sources"])
            self.seen.append(Seen((before - self.start_ns) / 1e9, frozenset(pairs), sources))


def _vehicles(deployment: dict[str, Any]) -> tuple[str, ...]:
    """The pair that a recorder records, from its arguments."""
    arguments = deployment["spec"]["template"]["spec"]["containers"][0]["args"]
    return tuple(each.split("/")[1] for each in arguments if each.startswith("--key=vehicles/"))


def free_endpoint() -> str:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{found.getsockname()[1]}"


def apply_example(api: Api, namespace: str, endpoint: str) -> None:
    """The example's own files, but for the endpoint."""
    for file in ("templates.yaml", "rules.yaml", "detector.yaml"):
        for document in yaml.safe_load_all((EXAMPLE / file).read_text(encoding="utf-8")):
            document["metadata"]["namespace"] = namespace
            if document["kind"] == "Detector":
                document["spec"]["zenoh"]["listen"] = [endpoint]
            api.apply(document)


def drive(endpoint: str, start_ns: int, *more: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, str(EXAMPLE / "drive.py"), "--connect", endpoint, "--start", str(start_ns)]
    return subprocess.Popen([*command, "--seed", str(SEED), "--duration", str(DURATION), *more])


def test_the_deployments_over_time_are_those_that_the_positions_call_for(
    api: Api, namespace: str, processes: Processes, tmp_path: Path
) -> None:
    endpoint = free_endpoint()
    apply_example(api, namespace, endpoint)
    processes.start("application-manager", "run", "--namespace", namespace)
    intake = tmp_path / "intake.mcap"
    live = tmp_path / "live"
    detector = processes.start(
        "detector", "run", "--name", "town", "--namespace", namespace,
        "--output", str(live), "--record-intake", str(intake),
    )  # fmt: skip
    detector.wait_for_output("Detector town runs with 1 rules")
    start_ns = time.time_ns() + 3_000_000_000
    observer = Observer(api, start_ns)
    with observer.watching():
        assert drive(endpoint, start_ns).wait(DURATION + 20) == 0
        api.wait_list("Deployment", lambda found: not found, timeout=20, what="all applications are gone")
    assert detector.terminate() == 0

    judge = episodes(simulate(SEED, DURATION), DURATION)
    assert len(judge) >= 4
    assert_recorders(observer.seen, recorders(judge, LINGER))
    assert_fusions(observer.seen, fusions(judge, LINGER))
    tasks = api.wait_list(
        "ApplicationTask",
        lambda found: all(task.get("status", {}).get("phase") == "Finished" for task in found),
        what="all tasks are finished",
    )
    assert len(tasks) == 2 * len(judge)

    replayed = tmp_path / "replayed"
    subprocess.run(
        [sys.executable, "-m", "detector.cli", "replay", str(intake), "--output", str(replayed)], check=True, timeout=60
    )
    assert (replayed / "events.jsonl").read_bytes() == (live / "events.jsonl").read_bytes()
    assert len((live / "events.jsonl").read_text().splitlines()) == 2 * len(judge)


def assert_recorders(seen: list[Seen], spans: dict[tuple[str, str], list[Any]]) -> None:
    """A recorder exists when its pair's span says so, give or take what is allowed, and at no other time."""
    assert len(seen) > DURATION * 4, "the observer must have looked often enough to prove anything"
    for moment in seen:
        for pair in spans.keys() | moment.pairs:
            exists = pair in moment.pairs
            must = any(
                span.start_s + ALLOWED <= moment.at <= (span.end_s or DURATION) - SAMPLING
                for span in spans.get(pair, [])
            )
            may = any(
                span.start_s - SAMPLING <= moment.at <= (span.end_s or DURATION) + ALLOWED
                for span in spans.get(pair, [])
            )
            assert exists or not must, f"at {moment.at:.2f} s there is no recorder for {pair}: {spans.get(pair)}"
            assert may or not exists, f"at {moment.at:.2f} s there is a recorder for {pair}: {spans.get(pair)}"


def assert_fusions(seen: list[Seen], expected: dict[str, list[Any]]) -> None:
    """The sources at a place are at each moment those of some state that is due about then."""
    met = dict.fromkeys(expected, 0)
    for moment in seen:
        for place, states in expected.items():
            sources = moment.sources.get(place)
            due = {
                tuple(state.sources)
                for state in states
                if state.start_s - SAMPLING <= moment.at <= (state.end_s or DURATION) + ALLOWED
            }
            settled = any(
                state.start_s + ALLOWED <= moment.at <= (state.end_s or DURATION) - SAMPLING for state in states
            )
            if sources is None:
                assert not settled, f"at {moment.at:.2f} s there is no fusion at {place}: {states}"
            else:
                assert sources in due, f"at {moment.at:.2f} s the fusion at {place} has {sources}, due is {due}"
                met[place] += 1
    assert all(met.values()), f"each place must have been seen fused: {met}"


def events_of(folder: Path) -> list[str]:
    return (folder / "events.jsonl").read_text(encoding="utf-8").splitlines()


def test_with_clock_data_a_recording_gives_the_same_events_played_live_and_replayed(
    processes: Processes, tmp_path: Path
) -> None:
    endpoint = free_endpoint()
    detector_file = tmp_path / "detector.yaml"
    document = yaml.safe_load((EXAMPLE / "detector.yaml").read_text(encoding="utf-8"))
    document["spec"] |= {"clock": "Data", "lateness": "300ms", "zenoh": {"mode": "peer", "listen": [endpoint]}}
    detector_file.write_text(yaml.safe_dump(document), encoding="utf-8")
    recording = tmp_path / "drive.mcap"
    start_ns = 1_767_225_600_000_000_000
    assert drive(endpoint, start_ns, "--record", str(recording)).wait(60) == 0

    files = ["--detector", str(detector_file), "--rules", str(EXAMPLE / "rules.yaml")]
    live, replayed = tmp_path / "live", tmp_path / "replayed"
    detector = processes.start("detector", "run", *files, "--output", str(live))
    detector.wait_for_output("Detector town runs with 1 rules")
    assert drive(endpoint, start_ns).wait(DURATION + 30) == 0
    expected = 2 * len(episodes(simulate(SEED, DURATION), DURATION))
    wait_until(lambda: len(events_of(live)), lambda count: count >= expected, timeout=20, what="all events are there")
    assert detector.terminate() == 0
    subprocess.run(
        [sys.executable, "-m", "detector.cli", "replay", str(recording), *files, "--output", str(replayed)],
        check=True,
        timeout=60,
    )
    assert events_of(replayed) == events_of(live)
    assert len(events_of(live)) == expected
