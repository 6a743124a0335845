"""A rule starts and stops a ROS 2 recorder: a `detector run` process and a simulated node, over real Zenoh."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from detector.assembly.checking import findings
from tests.driving import a_detector, a_rule
from tests.process.ros2_services import HASHES, Node
from tests.process.running import Process
from wayside.api import EventRule
from wayside.api.documents import load_documents

SPEED = {"name": "v", "stream": "speed", "value": "msg.v"}
NOTHING: dict[str, Any] = {}


@pytest.fixture
def process(tmp_path: Path) -> Iterator[Process]:
    """A detector that the test starts with its own rule."""
    process = Process(tmp_path)
    yield process
    assert process.stop() == 0


def start_with(process: Process, rule: EventRule) -> None:
    process.write(rule)
    process.start()


def fast(give_up: str = "5m", timeout: str = "30s", **ros2: Any) -> EventRule:
    trigger = {"ros2": ros2, "timeout": timeout, "giveUpAfter": give_up}
    return a_rule(
        "fast",
        signals=[SPEED],
        when="v > 10",
        evaluation={"every": "100ms"},
        actions=[{"name": "bag", "trigger": trigger}],
    )


def call(service: str, name: str, **fields: Any) -> dict[str, Any]:
    return {"service": f"/rosbag2_recorder/{service}", "type": f"rosbag2_interfaces/srv/{name}", **fields}


def test_a_service_of_rmw_zenoh_is_called_once_for_each_episode(process: Process) -> None:
    """With exactly the key of a std_srvs node, and the attachment that its server requires."""
    start_with(process, fast(domain=7, stop={"service": "/recorder/snap", "type": "std_srvs/srv/Trigger"}))
    node = Node(process.vehicle, domain=7)
    served = {"success": True, "message": "snapped"}
    node.offer(
        "recorder/snap",
        "std_srvs/srv/Trigger",
        "",
        "bool success\nstring message\n",
        lambda request: served,
        HASHES["std_srvs/srv/Trigger"],
    )
    process.send("car1", {"v": 20})
    process.send("car2", {"v": 20})
    process.status_when(lambda status: status.rules[0].open == 2)
    process.send("car1", {"v": 1})
    process.send("car2", {"v": 1})
    status = process.status_when(lambda status: bool(status.actions and status.actions[0].done == 2))
    assert node.names == ["recorder/snap"] * 2
    assert len(node.askers) == 1
    assert [(each.kind, each.running, each.failed) for each in status.actions] == [("trigger", 0, 0)]


def test_episodes_that_overlap_are_one_recording_of_a_bridged_recorder(process: Process) -> None:
    start_with(process, fast(layout="Plain", start=call("resume", "Resume"), stop=call("pause", "Pause")))
    node = Node(process.vehicle, bridged=True)
    node.offer("rosbag2_recorder/resume", "rosbag2_interfaces/srv/Resume", "", "", lambda request: NOTHING)
    node.offer("rosbag2_recorder/pause", "rosbag2_interfaces/srv/Pause", "", "", lambda request: NOTHING)
    process.send("car1", {"v": 20})
    process.send("car2", {"v": 20})
    process.status_when(lambda status: status.rules[0].open == 2)
    process.send("car1", {"v": 1})
    process.status_when(lambda status: bool(status.actions and status.actions[0].done == 1))
    assert node.names == ["rosbag2_recorder/resume"]
    process.send("car2", {"v": 1})
    process.status_when(lambda status: bool(status.actions and status.actions[0].done == 2))
    assert node.names == ["rosbag2_recorder/resume", "rosbag2_recorder/pause"]


def test_a_silent_service_is_called_again_and_an_earlier_success_is_no_failure(process: Process) -> None:
    """rosbag2 answers 1 to a second Record: after a call without a response this shows that it had arrived."""
    start = call("record", "Record", request={"uri": "/bags/${client}-${int(v)}"})
    start_with(process, fast(timeout="1s", layout="Plain", start=start, stop=call("stop", "Stop")))
    node = Node(process.vehicle, bridged=True)
    uris: list[str] = []
    heard = threading.Event()

    def record(request: Any) -> dict[str, Any] | None:
        uris.append(request["uri"])
        return None if not heard.is_set() else {"return_code": 1, "error_string": "already recording"}

    code = "int32 return_code\nstring error_string\n"
    node.offer("rosbag2_recorder/record", "rosbag2_interfaces/srv/Record", "string uri\n", code, record)
    node.offer(
        "rosbag2_recorder/stop",
        "rosbag2_interfaces/srv/Stop",
        "",
        code,
        lambda request: {"return_code": 0, "error_string": ""},
    )
    process.send("car1", {"v": 20})
    node.wait_for(lambda calls: len(calls) >= 1)
    status = process.status_when(lambda status: bool(status.actions and status.actions[0].current))
    assert "start is not confirmed yet: /rosbag2_recorder/record" in next(iter(status.actions[0].current.values()))
    heard.set()
    process.status_when(lambda status: "not confirmed" not in str(status.actions[0].current))
    process.send("car1", {"v": 1})
    process.status_when(lambda status: status.actions[0].done == 1)
    assert node.names[-1] == "rosbag2_recorder/stop"
    assert len(uris) >= 2
    assert set(uris) == {"/bags/car1-20"}


def test_a_rejection_by_a_service_is_reported(process: Process) -> None:
    start = {"service": "/recorder/on", "type": "std_srvs/srv/Trigger"}
    start_with(process, fast("5s", layout="Plain", start=start))
    node = Node(process.vehicle, bridged=True)
    refusal = {"success": False, "message": "the disk is full"}
    node.offer("recorder/on", "std_srvs/srv/Trigger", "", "bool success\nstring message\n", lambda request: refusal)
    process.send("car1", {"v": 20})
    status = process.status_when(lambda status: bool(status.actions and status.actions[0].failed))
    assert status.actions[0].last_failure == "gave up starting the recording: /recorder/on refused: the disk is full"
    assert len(node.calls) >= 2


def test_errors_of_a_service_call_are_reported_by_field(tmp_path: Path) -> None:
    documents = [
        a_detector().to_json(),
        fast(
            start={"service": "/a", "type": "my/srv/Own"},
            stop={"service": "/b", "type": "std_srvs/srv/SetBool", "request": {"data": 3, "more": "${v}"}},
        ).to_json(),
        fast(start={"service": "/a", "type": "my/srv/Own", "definition": "int8 x\n"}).to_json(),
    ]
    documents[2]["metadata"]["name"] = "second"
    (tmp_path / "all.yaml").write_text(yaml.safe_dump_all(documents, sort_keys=False))
    reported = [str(problem) for problem in findings(load_documents([tmp_path / "all.yaml"])).problems]
    assert [text.split("all.yaml:", 1)[1].split(" ", 1)[1] for text in reported] == [
        "spec.actions[0].trigger.ros2.start.type: unknown service type my/srv/Own: give its .srv file as definition",
        "spec.actions[0].trigger.ros2.stop.request: request.data must be of type bool; got 3",
        "spec.actions[0].trigger.ros2.start.definition: the definition of my/srv/Own must have exactly one "
        "line of ---, between request and response; got 0",
    ]


@pytest.mark.parametrize(
    ("ros2", "reported"),
    [
        ({"layout": "Plain"}, "give start, stop or both"),
        (
            {"layout": "Plain", "domain": 3, "stop": call("pause", "Pause")},
            "domain is valid only with layout RmwZenoh",
        ),
    ],
)
def test_invalid_settings_are_rejected(ros2: dict[str, Any], reported: str) -> None:
    with pytest.raises(ValueError, match=reported):
        fast(**ros2)
