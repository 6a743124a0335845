"""The whole chain live: vehicles on real Zenoh, both programs as processes, a real API server.

The objects over time are compared with those computed from the simulated positions
(`cooperative_recording.expected`, which shares no code with either program).
"""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from tests.cluster.api import Api
from tests.cluster.processes import Processes
from tests.cluster.repeating import repeated
from tests.cluster.waiting import wait_until
from tests.patience import PATIENCE
from tests.ports import free_endpoint

EXAMPLE = Path(__file__).parents[2] / "examples" / "cooperative-recording"
sys.path.insert(0, str(EXAMPLE))

from cooperative_recording.expected import LINGER, episodes, fusions, recorders  # noqa: E402  the example is no package
from cooperative_recording.vehicles import simulate  # noqa: E402

SEED, DURATION = 3528, 25.0
EVALUATION = 0.5  # s, of the example's rule
REACTION = 2.0  # s from the evaluation until the Deployment is created or deleted
REQUESTS = 10  # the period of queries to the API server
LOOKING = 0.1  # s between two lists of the observer
SAMPLING = 0.2  # s: a pose is up to 0.1 s old, and so is what the observer saw


@dataclass
class Snapshot:
    """The objects at one moment."""

    since_ns: int  # the epoch
    took_s: float  # to look
    pairs: frozenset[tuple[str, ...]]
    sources: dict[str, tuple[str, ...]]


@dataclass
class Observer:
    """Lists the Deployments and ConfigMaps of a namespace ten times a second."""

    api: Api
    seen: list[Snapshot] = field(default_factory=list)

    def watching(self) -> AbstractContextManager[None]:
        return repeated("observer", self.look, LOOKING)

    def look(self) -> None:
        before, began = time.time_ns(), time.monotonic()
        deployments = self.api.list("Deployment")
        configurations = {each["metadata"]["name"]: each for each in self.api.list("ConfigMap")}
        pairs = {_vehicles(each) for each in deployments if each["metadata"]["name"].startswith("scene-recorder")}
        sources = {}
        for each in deployments:
            found = configurations.get(f"{each['metadata']['name']}-sources")
            if found is not None:
                content = yaml.safe_load(found["data"]["sources.yaml"])
                sources[content["place"]] = tuple(content["sources"])
        self.seen.append(Snapshot(before, time.monotonic() - began, frozenset(pairs), sources))


def _vehicles(deployment: dict[str, Any]) -> tuple[str, ...]:
    """The pair that a recorder records, from its arguments."""
    arguments = deployment["spec"]["template"]["spec"]["containers"][0]["args"]
    return tuple(each.split("/")[1] for each in arguments if each.startswith("--key=vehicles/"))


def apply_example(api: Api, namespace: str, endpoint: str) -> None:
    """The example's own files with another endpoint."""
    for file in ("templates.yaml", "rules.yaml", "detector.yaml"):
        for document in yaml.safe_load_all((EXAMPLE / file).read_text(encoding="utf-8")):
            document["metadata"]["namespace"] = namespace
            if document["kind"] == "Detector":
                document["spec"]["zenoh"]["listen"] = [endpoint]
            api.apply(document)


def drive(endpoint: str, *more: str) -> str:
    """Let the vehicles drive; returns their output."""
    command = [sys.executable, str(EXAMPLE / "drive.py"), "--connect", endpoint, "--wait", f"{PATIENCE:g}"]
    command += ["--seed", str(SEED), "--duration", str(DURATION), *more]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, timeout=DURATION + 2 * PATIENCE)
    return done.stdout


def test_the_deployments_over_time_match_the_vehicles_positions(
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
    observer = Observer(api)
    with observer.watching():
        logged = re.search(r"stamps from (\d+) ns, at most (\d+) ms late$", drive(endpoint).strip())
        assert logged is not None
        api.wait_list("Deployment", lambda found: not found, what="all applications are deleted")
    assert detector.terminate() == 0

    judge = episodes(simulate(SEED, DURATION), DURATION)
    assert len(judge) >= 4
    seen = Timeline(observer.seen, start_ns=int(logged[1]), late_s=int(logged[2]) / 1000)
    assert_recorders(seen, recorders(judge, LINGER))
    assert_fusions(seen, fusions(judge, LINGER))
    tasks = api.wait_list(
        "ApplicationTask",
        lambda found: all(task.get("status", {}).get("phase") == "Finished" for task in found),
        what="all tasks are finished",
    )
    assert len(tasks) == 2 * len(judge)

    replayed = tmp_path / "replayed"
    subprocess.run(
        [sys.executable, "-m", "detector.commands.cli", "replay", str(intake), "--output", str(replayed)],
        check=True,
        timeout=PATIENCE,
    )
    assert (replayed / "events.jsonl").read_bytes() == (live / "events.jsonl").read_bytes()
    assert len((live / "events.jsonl").read_text().splitlines()) == 2 * len(judge)


@dataclass
class Timeline:
    """The snapshots by seconds into the drive, and their maximum delay.

    A slow machine also slows the vehicles and the observer. The results may be late by the sum of three delays: of the
    poses, of the API server, and of the observer's own lists.
    """

    seen: list[Snapshot]
    start_ns: int
    late_s: float

    @property
    def allowed(self) -> float:
        took = max(each.took_s for each in self.seen)
        return EVALUATION + REACTION + self.late_s + self._kept_s + REQUESTS * took

    @property
    def _kept_s(self) -> float:
        """The delay of the observer's lists."""
        pauses = ((after.since_ns - each.since_ns) / 1e9 - each.took_s for each, after in pairwise(self.seen))
        return max(0.0, max(pauses) - LOOKING)

    def __iter__(self) -> Iterator[tuple[float, Snapshot]]:
        return (((each.since_ns - self.start_ns) / 1e9, each) for each in self.seen)


def assert_recorders(seen: Timeline, spans: dict[tuple[str, str], list[Any]]) -> None:
    """A recorder exists during its pair's span, within the tolerance, and at no other time."""
    assert len(seen.seen) > DURATION, "the observer must have listed often enough for a meaningful result"
    assert {pair for _, moment in seen for pair in moment.pairs} == spans.keys()
    allowed = seen.allowed
    for at, moment in seen:
        until = at + moment.took_s  # a list does not show when within this time the state held
        for pair, its in spans.items():
            exists = pair in moment.pairs
            must = any(span.start_s + allowed <= at and until <= (span.end_s or DURATION) - SAMPLING for span in its)
            may = any(span.start_s - SAMPLING <= until and at <= (span.end_s or DURATION) + allowed for span in its)
            assert exists or not must, f"at {at:.2f} s (+ {allowed:.2f} s) there is no recorder for {pair}: {its}"
            assert may or not exists, f"at {at:.2f} s (+ {allowed:.2f} s) there is a recorder for {pair}: {its}"


def assert_fusions(seen: Timeline, expected: dict[str, list[Any]]) -> None:
    """The sources at a place are at each moment those of an expected state at about that time."""
    met = dict.fromkeys(expected, 0)
    allowed = seen.allowed
    for at, moment in seen:
        until = at + moment.took_s
        for place, states in expected.items():
            sources = moment.sources.get(place)
            due = {
                tuple(state.sources)
                for state in states
                if state.start_s - SAMPLING <= until and at <= (state.end_s or DURATION) + allowed
            }
            settled = any(
                state.start_s + allowed <= at and until <= (state.end_s or DURATION) - SAMPLING for state in states
            )
            if sources is None:
                assert not settled, f"at {at:.2f} s there is no fusion at {place}: {states}"
            else:
                assert sources in due, f"at {at:.2f} s the fusion at {place} has {sources}, not {due}"
                met[place] += 1
    assert all(met.values()), f"each place must have had a fusion: {met}"


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
    drive(endpoint, "--start", str(start_ns), "--record", str(recording))

    files = ["--detector", str(detector_file), "--rules", str(EXAMPLE / "rules.yaml")]
    live, replayed = tmp_path / "live", tmp_path / "replayed"
    detector = processes.start("detector", "run", *files, "--output", str(live))
    detector.wait_for_output("Detector town runs with 1 rules")
    drive(endpoint, "--start", str(start_ns))
    expected = 2 * len(episodes(simulate(SEED, DURATION), DURATION))
    wait_until(lambda: len(events_of(live)), lambda count: count >= expected, what="all events are written")
    assert detector.terminate() == 0
    subprocess.run(
        [sys.executable, "-m", "detector.commands.cli", "replay", str(recording), *files, "--output", str(replayed)],
        check=True,
        timeout=PATIENCE,
    )
    assert events_of(replayed) == events_of(live)
    assert len(events_of(live)) == expected
