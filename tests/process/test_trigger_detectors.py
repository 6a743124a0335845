"""One detector starts recordings of another: two `detector run` processes and a router, over real Zenoh."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader
from typer.testing import CliRunner, Result

from detector.actions.trigger.requests import (
    Progress,
    RecordingReport,
    RecordingRequest,
    read_report,
    read_reports,
    write_request,
)
from detector.commands.cli import app
from detector.streams.query_handler import status_key
from detector.streams.session import open_session
from tests.driving import a_rule
from tests.networks import router_process, wait_for
from tests.patience import PATIENCE
from tests.ports import free_endpoint
from tests.process.running import Process
from wayside.api import EventRule
from wayside.api.base import Duration, PositiveDuration
from wayside.api.zenoh import Zenoh, ZenohMode

SPEED = {"name": "v", "stream": "speed", "value": "msg.v"}


class Peer(Process):
    """A detector of this name that is a client of the router."""

    def __init__(self, folder: Path, endpoint: str, name: str) -> None:
        folder.mkdir(exist_ok=True)
        super().__init__(folder)
        self.endpoint, self.name = endpoint, name
        self.network = Zenoh(mode=ZenohMode.CLIENT, connect=[endpoint])

    def write(self, *rules: Any, streams: tuple[dict[str, Any], ...] = (), **spec: Any) -> None:
        super().write(*rules, streams=streams, **spec)
        path = self.folder / "detector.yaml"
        document = json.loads(path.read_text())
        document["metadata"]["name"] = self.name
        document["spec"]["zenoh"] = {"mode": "client", "connect": [self.endpoint]}
        path.write_text(json.dumps(document))

    def kill(self) -> None:
        self.vehicle.close()  # type: ignore[no-untyped-call]
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(PATIENCE)

    def folders(self) -> list[Path]:
        """The recordings with their final names."""
        return sorted(path.parent for path in (self.folder / "recordings").glob("*/*/metadata.yaml"))

    def under_way(self) -> int:
        """The number of written messages of recordings in progress."""
        found = 0
        for path in (self.folder / "recordings").glob("*/.*/*.mcap"):
            with suppress(FileNotFoundError, McapError), path.open("rb") as file:
                for _ in NonSeekingReader(file).iter_messages(log_time_order=False):
                    found += 1
        return found

    def recorded(self, folder: Path) -> list[tuple[str, Any]]:
        """The topics and messages of a recording, in order."""
        messages = []
        for path in sorted(folder.glob("*.mcap")):
            with path.open("rb") as file:
                messages += [(c.topic, json.loads(m.data)) for _, c, m in make_reader(file).iter_messages()]
        return messages


@pytest.fixture
def endpoint() -> Iterator[str]:
    where = free_endpoint()
    with router_process(where):
        yield where


def a_recorder(folder: Path, endpoint: str) -> Peer:
    """A detector that records on request."""
    peer = Peer(folder / "rsu", endpoint, "rsu")
    idle = a_rule("idle", signals=[SPEED], when="v > 1000")
    peer.write(idle, recordings={"path": str(folder / "rsu" / "recordings"), "onRequest": {}}, clientTimeout="60s")
    peer.start()
    return peer


@pytest.fixture
def rsu(endpoint: str, tmp_path: Path) -> Iterator[Peer]:
    peer = a_recorder(tmp_path, endpoint)
    yield peer
    if peer.process.poll() is None:
        assert peer.stop() == 0


@pytest.fixture(scope="module")
def unhurt(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Peer]:
    """A recorder that several tests use, one after the other."""
    where = free_endpoint()
    with router_process(where):
        peer = a_recorder(tmp_path_factory.mktemp("unhurt"), where)
        yield peer
        assert peer.stop() == 0


@pytest.fixture
def town(endpoint: str, tmp_path: Path) -> Iterator[Peer]:
    """It detects."""
    peer = Peer(tmp_path / "town", endpoint, "town")
    peer.write(fast(), state={"path": str(tmp_path / "state")})
    peer.start()
    yield peer
    if peer.process.poll() is None:
        assert peer.stop() == 0


def fast(name: str = "rsu", **trigger: Any) -> EventRule:
    detector = {"name": name, "streams": ["pose"], "before": "30s"}
    trigger = {"detector": detector, "timeout": "1s", **trigger}
    return a_rule(
        "fast",
        signals=[SPEED],
        when="v > 10",
        evaluation={"every": "100ms"},
        actions=[{"name": "other", "trigger": trigger}],
    )


def requested(endpoint: str, request: RecordingRequest, name: str = "rsu") -> RecordingReport:
    with open_session(Zenoh(mode=ZenohMode.CLIENT, connect=[endpoint])) as session:
        for reply in session.get(status_key(name, "recordings"), payload=write_request(request), timeout=PATIENCE):
            if reply.ok is not None:
                return read_report(reply.ok.payload.to_bytes())
            raise ValueError(reply.err.payload.to_string())
    raise AssertionError("no answer")


def listed(endpoint: str, name: str = "rsu") -> list[RecordingReport]:
    with open_session(Zenoh(mode=ZenohMode.CLIENT, connect=[endpoint])) as session:
        for reply in session.get(status_key(name, "recordings"), timeout=PATIENCE):
            if reply.ok is not None:
                return read_reports(reply.ok.payload.to_bytes())
    raise AssertionError("no answer")


def recording(endpoint: str) -> bool:
    return any(report.state is Progress.RECORDING for report in listed(endpoint))


def test_another_detector_records_the_episode_and_the_time_before_it(rsu: Peer, town: Peer) -> None:
    for number in range(20):
        town.send("car1", {"n": number}, "pose")
    rsu.status_when(lambda status: status.streams[0].samples == 20)
    town.send("car1", {"v": 20})
    wait_for(lambda: recording(town.endpoint), PATIENCE)
    for number in range(20, 40):
        town.send("car1", {"n": number}, "pose")
    rsu.status_when(lambda status: status.streams[0].samples == 40)
    town.send("car1", {"v": 1})
    status = town.status_when(lambda status: bool(status.actions and status.actions[0].done == 1))
    (reported,) = status.actions
    assert (reported.samples, reported.files, reported.failed, reported.running) == (40, 1, 0, 0)
    (folder,) = rsu.folders()
    assert rsu.recorded(folder) == [("/vehicles/car1/pose", {"n": number}) for number in range(40)]
    (report,) = listed(town.endpoint)
    assert (report.state, report.samples, report.streams) == (Progress.DONE, 40, ["pose"])
    assert report.id.startswith("town.fast.other.")


def test_a_start_and_a_stop_may_come_twice_and_in_any_order(unhurt: Peer) -> None:
    start = RecordingRequest(do="start", id="x", streams=["pose"])
    stop = RecordingRequest(do="stop", id="x")
    assert requested(unhurt.endpoint, start).state is Progress.RECORDING
    again = requested(unhurt.endpoint, start)
    assert again.state is Progress.RECORDING
    assert requested(unhurt.endpoint, stop).state in (Progress.ENDING, Progress.DONE)
    wait_for(lambda: requested(unhurt.endpoint, RecordingRequest(id="x")).state is Progress.DONE, PATIENCE)
    assert requested(unhurt.endpoint, stop).state is Progress.DONE
    assert requested(unhurt.endpoint, start).state is Progress.DONE
    assert [each.id for each in listed(unhurt.endpoint)].count("x") == 1
    assert len(requested(unhurt.endpoint, stop).files) == 1

    late = RecordingRequest(do="stop", id="y")
    assert requested(unhurt.endpoint, late).state is Progress.UNKNOWN
    begun = requested(unhurt.endpoint, RecordingRequest(do="start", id="y"))
    assert (begun.state, begun.message) == (Progress.UNKNOWN, "the recording was stopped before it was started")


def test_a_recording_whose_stop_never_comes_ends_by_itself(unhurt: Peer) -> None:
    request = RecordingRequest(do="start", id="long", max_duration=PositiveDuration("1s"))
    report = requested(unhurt.endpoint, request)
    assert report.state is Progress.RECORDING
    wait_for(lambda: requested(unhurt.endpoint, RecordingRequest(id="long")).state is Progress.DONE, PATIENCE)
    done = requested(unhurt.endpoint, RecordingRequest(id="long"))
    assert (done.message, done.until) == ("ended by its maxDuration", report.until)


def test_a_request_that_is_not_allowed_is_rejected(rsu: Peer, town: Peer) -> None:
    refused = requested(rsu.endpoint, RecordingRequest(do="start", id="x", streams=["poes"]))
    assert (refused.state, refused.message) == (
        Progress.REFUSED,
        "stream poes may not be recorded here; the permitted streams are pose, speed",
    )
    refused = requested(rsu.endpoint, RecordingRequest(do="start", id="x"), "town")
    assert refused.message.startswith("this detector accepts no recording requests")
    for number in range(8):
        assert requested(rsu.endpoint, RecordingRequest(do="start", id=f"x{number}")).state is Progress.RECORDING
    full = requested(rsu.endpoint, RecordingRequest(do="start", id="x8"))
    assert full.message == "8 recordings are in progress, the maximum (recordings.onRequest.maxRecordings)"
    with pytest.raises(ValueError, match="start requires the id of the recording"):
        requested(rsu.endpoint, RecordingRequest(do="start"))


def test_a_killed_requester_comes_back_and_stops_what_it_started(rsu: Peer, town: Peer) -> None:
    town.send("car1", {"v": 20})
    wait_for(lambda: recording(town.endpoint), PATIENCE)
    wait_for(lambda: '"episode"' in "".join(p.read_text() for p in (town.folder.parent / "state").glob("*.json")))
    town.kill()
    assert recording(rsu.endpoint)
    town.start()
    town.status_when(lambda status: status.rules[0].open == 1 and any(each.running == 1 for each in status.actions))
    assert [each.state for each in listed(rsu.endpoint)] == [Progress.RECORDING]
    town.send("car1", {"v": 1})
    town.status_when(lambda status: status.actions[0].done == 1)
    assert [each.state for each in listed(rsu.endpoint)] == [Progress.DONE]


def test_a_restarted_requester_without_its_episode_stops_the_recording(rsu: Peer, town: Peer) -> None:
    """Its rule differs after the restart: the journal has the recordings to stop."""
    town.send("car1", {"v": 20})
    wait_for(lambda: recording(town.endpoint), PATIENCE)
    town.kill()
    changed = fast()
    changed = changed.model_copy(update={"spec": changed.spec.model_copy(update={"when": "v > 11"})})
    town.write(changed, state={"path": str(town.folder.parent / "state")})
    town.start()
    wait_for(lambda: [each.state for each in listed(rsu.endpoint)] == [Progress.DONE], PATIENCE)


def test_a_recorder_that_is_killed_continues_when_it_is_back(rsu: Peer, town: Peer) -> None:
    """The existing part is kept as truncated; the requester repeats the start within seconds."""
    town.send("car1", {"v": 20})
    wait_for(lambda: recording(town.endpoint), PATIENCE)
    town.send("car1", {"n": 1}, "pose")
    wait_for(lambda: rsu.under_way() == 1, PATIENCE)  # a kill loses unwritten data
    rsu.kill()
    rsu.start()
    wait_for(lambda: recording(rsu.endpoint), PATIENCE)
    rsu.send("car1", {"n": 2}, "pose")
    rsu.status_when(lambda status: status.streams[0].samples == 1)
    town.send("car1", {"v": 1})
    town.status_when(lambda status: status.actions[0].done == 1)
    wait_for(lambda: len(rsu.folders()) == 2, PATIENCE)
    assert [rsu.recorded(folder)[-1:] for folder in rsu.folders() if "cut" not in folder.name] == [
        [("/vehicles/car1/pose", {"n": 2})]
    ]


def test_without_a_recorder_only_the_recording_is_missing(endpoint: str, tmp_path: Path) -> None:
    town = Peer(tmp_path / "town", endpoint, "town")
    town.write(fast("nobody", giveUpAfter="2s"))
    town.start()
    town.send("car1", {"v": 20})
    status = town.status_when(lambda status: any(each.running == 1 and each.current for each in status.actions))
    assert "no response" in next(iter(status.actions[0].current.values()))
    town.send("car1", {"v": 1})
    town.status_when(lambda status: status.rules[0].ended == 1)
    status = town.status_when(lambda status: status.actions[0].failed == 1)
    assert status.actions[0].last_failure.startswith("gave up starting the recording:")
    lost = town.status_when(lambda status: any(drops.cause.startswith("action_recordings") for drops in status.drops))
    assert [drops.count for drops in lost.drops if drops.cause.startswith("action_recordings")] == [1]
    assert town.stop() == 0


def test_people_request_recordings_by_commands(unhurt: Peer) -> None:
    def command(*words: str) -> Result:
        return CliRunner().invoke(app, [*words, "--connect", unhurt.endpoint, "--timeout", str(PATIENCE / 4)])

    begun = command("recordings", "start", "mine", "--stream", "pose", "--name", "rsu", "--json")
    assert json.loads(begun.stdout)["state"] == "Recording"
    assert command("recordings", "stop", "mine", "--name", "rsu").exit_code == 0
    wait_for(lambda: requested(unhurt.endpoint, RecordingRequest(id="mine")).state is Progress.DONE, PATIENCE)
    reported = command("recordings", "status").stdout
    assert "rsu" in reported
    assert "mine" in reported
    assert "Done" in reported
    refused = command("recordings", "start", "other", "--stream", "poes", "--name", "rsu")
    assert refused.exit_code == 1
    assert "stream poes may not be recorded here" in refused.stdout
    wrong = command("recordings", "start", "x", "--name", "rsu", "--max-duration", "1 hour")
    assert "maxDuration: must be a duration" in wrong.output
    shown = command("status", "--name", "rsu").stdout
    assert "_requested/record" in shown


def test_path_characters_of_a_request_do_not_reach_file_names(unhurt: Peer) -> None:
    """Its subject is a part of file names."""
    request = RecordingRequest(
        do="start", id="stranger", event={"subject": "../../../x", "data": {"classification": 3}}
    )
    assert requested(unhurt.endpoint, request).state is Progress.RECORDING
    requested(unhurt.endpoint, RecordingRequest(do="stop", id="stranger", after=Duration("0s")))
    wait_for(lambda: requested(unhurt.endpoint, RecordingRequest(id="stranger")).state is Progress.DONE, PATIENCE)
    (file,) = requested(unhurt.endpoint, RecordingRequest(id="stranger")).files
    assert "~fleet" in file
    assert ".." not in file
