"""Open episodes and their demands continue through failures of the detector and the API server."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from detector.engine.samples.sample import Arrival
from detector.replay.intake_file import read_intake
from detector.replay.message import RecordingError
from tests import programs
from tests.cluster.chain import (
    BETWEEN,
    BUSES,
    CARS,
    FAR,
    HOLDER,
    NEAR,
    TRAMS,
    VANS,
    Chain,
    Vehicles,
    template,
    untouched,
)
from tests.cluster.children import GRACE
from tests.cluster.controlplane import ControlPlane
from tests.cluster.waiting import wait_until
from wayside.times import parse_time

SECOND = 10**9  # ns
RUNS = f"Detector {HOLDER} runs with"


def test_a_detector_killed_during_an_episode_continues_it(chain: Chain, vehicles: Vehicles) -> None:
    running = chain.start()
    vehicles.place(CARS, NEAR)
    deployed = chain.wait_deployed(CARS)
    task = chain.wait_task(CARS)
    (started,) = chain.wait_events(CARS, "started")
    running.kill9()
    vehicles.place(CARS, BETWEEN)
    running.start()
    running.wait_for_output(f"{RUNS} 1 rules and 1 restored demands")
    vehicles.place(VANS, NEAR)  # once theirs is there, the restored episode has been evaluated many times
    chain.wait_deployed(VANS)
    again = chain.wait_task(CARS)
    assert again["metadata"]["uid"] == task["metadata"]["uid"]
    assert again["spec"] == task["spec"]
    assert untouched(deployed, chain.deployment(CARS))

    vehicles.place(CARS, FAR)
    _, ended = chain.wait_events(CARS, "started", "Until")
    for field in ("episode", "onsetTime", "startTime"):
        assert ended["data"][field] == started["data"][field]
    chain.wait_removed(CARS)
    assert chain.live() == {"+".join(VANS)}
    chain.settled()


def test_after_its_lease_a_killed_detectors_demand_is_released_and_counts_again_when_it_is_back(
    chain: Chain, vehicles: Vehicles
) -> None:
    chain.apply(template(after="1s"))
    running = chain.start()
    vehicles.place(CARS, NEAR)
    deployed = chain.wait_deployed(CARS)
    task = chain.wait_task(CARS)
    running.kill9()
    vehicles.place(CARS, BETWEEN)
    chain.wait_removed(CARS)
    assert chain.wait_task(CARS)["metadata"]["uid"] == task["metadata"]["uid"], "only its holder ends a task"
    running.start()
    again = chain.wait_deployed(CARS)
    assert again["metadata"]["uid"] != deployed["metadata"]["uid"]
    assert chain.wait_task(CARS)["metadata"]["uid"] == task["metadata"]["uid"]
    chain.settled()


@pytest.mark.own_control_plane
def test_an_outage_of_the_api_server_releases_nothing_and_loses_nothing(
    chain: Chain, vehicles: Vehicles, control_plane: ControlPlane
) -> None:
    chain.apply(template(after="1s"))
    running = chain.start()
    for pair in (CARS, VANS):
        vehicles.place(pair, NEAR)
    before = {pair: chain.wait_deployed(pair) for pair in (CARS, VANS)}
    with control_plane.outage():
        began = time.monotonic()
        vehicles.place(VANS, FAR)
        vehicles.place(BUSES, NEAR)
        vehicles.place(TRAMS, NEAR)
        chain.wait_events(VANS, "started", "Until")
        chain.wait_events(BUSES, "started")
        chain.wait_events(TRAMS, "started")
        vehicles.place(TRAMS, FAR)
        chain.wait_events(TRAMS, "started", "Until")
        rest = 20 - (time.monotonic() - began)  # longer than the Lease: the outage is under test
        time.sleep(max(rest, 0.0))
    chain.wait_deployed(BUSES)
    chain.wait_removed(VANS)
    assert untouched(before[CARS], chain.deployment(CARS))
    assert chain.live() == {"+".join(CARS), "+".join(BUSES)}
    chain.settled()
    assert untouched(before[CARS], chain.deployment(CARS))
    assert chain.deployment(TRAMS) is None
    assert running.starts == 1
    assert running.alive


@pytest.mark.own_control_plane
def test_a_detector_ends_and_starts_while_the_api_server_is_away(
    chain: Chain, vehicles: Vehicles, control_plane: ControlPlane
) -> None:
    running = chain.start()
    vehicles.place(CARS, NEAR)
    deployed = chain.wait_deployed(CARS)
    task = chain.wait_task(CARS)
    with control_plane.outage():
        assert running.terminate() == 0
        vehicles.place(CARS, BETWEEN)
        running.start()
        running.wait_for_output("WARNING")  # it logs why it waits
    running.wait_for_output(f"{RUNS} 1 rules and 1 restored demands")
    assert chain.wait_task(CARS)["metadata"]["uid"] == task["metadata"]["uid"]
    assert untouched(deployed, chain.deployment(CARS))
    vehicles.place(CARS, FAR)
    chain.wait_events(CARS, "started", "Until")
    chain.wait_removed(CARS)
    chain.settled()


def test_a_detector_that_is_stopped_ends_promptly_and_its_tasks_stay(chain: Chain, vehicles: Vehicles) -> None:
    running = chain.start()
    vehicles.place(CARS, NEAR)
    deployed = chain.wait_deployed(CARS)
    task = chain.wait_task(CARS)
    assert running.terminate(patience=GRACE) == 0
    assert chain.wait_task(CARS)["spec"] == task["spec"]
    lease = chain.api.get("Lease", f"wayside-{HOLDER}")
    assert not lease["spec"].get("holderIdentity"), "a successor need not wait"
    vehicles.place(CARS, BETWEEN)
    running.start()
    running.wait_for_output(f"{RUNS} 1 rules and 1 restored demands")
    vehicles.place(VANS, NEAR)
    chain.wait_deployed(VANS)
    assert chain.wait_task(CARS)["metadata"]["uid"] == task["metadata"]["uid"]
    assert untouched(deployed, chain.deployment(CARS))
    chain.wait_events(CARS, "started")


def test_the_intake_file_of_a_killed_detector_replays_up_to_the_truncation(
    chain: Chain, vehicles: Vehicles, tmp_path: Path
) -> None:
    intake = tmp_path / "intake.mcap"
    running = chain.start("--record-intake", str(intake))
    vehicles.place(CARS, NEAR)
    chain.wait_events(CARS, "started")
    vehicles.place(CARS, FAR)
    _, ended = chain.wait_events(CARS, "started", "Until")
    # A kill loses about the last second of the intake.
    until = parse_time(ended["data"]["endTime"]) + SECOND
    wait_until(lambda: newest(intake), lambda time: time > until, what="the intake file has the end of the episode")
    running.kill9()
    replayed = tmp_path / "replayed"
    done = programs.run("detector", "replay", intake, "--output", replayed, check=True)
    assert "its detector was killed" in done.stderr
    live = (chain.folder / "events.jsonl").read_bytes()
    assert (replayed / "events.jsonl").read_bytes() == live
    assert live.count(b"\n") == 2


def newest(intake: Path) -> int:
    """The newest receive time in an intake file that is being written, in nanoseconds since the epoch; 0: none yet."""
    try:
        return max((each.received for each in read_intake(intake) if isinstance(each, Arrival)), default=0)
    except RecordingError:
        return 0  # the start of the file is not written yet
