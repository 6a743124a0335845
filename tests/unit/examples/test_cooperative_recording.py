"""The case cooperative recording: a correct drive, and files as described in the README."""

from __future__ import annotations

import itertools
import queue
import re
import signal
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader

from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import Renderer
from tests.guides import ROOT
from tests.networks import session
from tests.patience import PATIENCE
from tests.ports import free_endpoint
from tests.unit.manager_objects import instance
from wayside.api import ApplicationTemplate, Detector, EventRule, Kind
from wayside.api.documents import load_documents
from wayside.rules import compile_rule

EXAMPLE = ROOT / "examples" / "cooperative-recording"
sys.path.insert(0, str(EXAMPLE))  # its folder's name has a dash, so it is no package of ours

from cooperative_recording.expected import APART, CLOSE, LINGER, place_at  # noqa: E402
from cooperative_recording.messages import POINTS_TYPE, POSE_TYPE, TYPESTORE, keys, messages  # noqa: E402
from cooperative_recording.network import choices, connection, lanes  # noqa: E402
from cooperative_recording.publish import UnreachableError, publish  # noqa: E402
from cooperative_recording.record import START_NS, record  # noqa: E402
from cooperative_recording.seeds import DEMO_DURATION_S, DEMO_SEED  # noqa: E402
from cooperative_recording.vehicles import ACCELERATION, FASTEST, LIDAR_VEHICLES, VEHICLES, simulate  # noqa: E402

NUMBER = r"-?\d+(?:\.\d+)?"


def documents() -> list[Kind]:
    return [each.object for each in load_documents([EXAMPLE / f"{n}.yaml" for n in ("detector", "rules", "templates")])]


def only(kind: type[Kind], name: str) -> Any:
    (found,) = [each for each in documents() if isinstance(each, kind) and each.name == name]
    return found


# The drive


def test_fifteen_vehicles_with_names_that_ros_accepts_and_enough_lidars_for_several_pairs() -> None:
    assert len({vehicle.name for vehicle in VEHICLES}) == 15
    assert all(vehicle.name.replace("_", "").isalnum() for vehicle in VEHICLES)
    assert len(LIDAR_VEHICLES) >= 4


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32), horizon=st.floats(5, 60))
def test_a_seed_decides_the_whole_drive_and_a_longer_horizon_only_adds_to_it(seed: int, horizon: float) -> None:
    times = np.linspace(0, 5, 51)
    one, other, longer = simulate(seed, horizon), simulate(seed, horizon), simulate(seed, 90)
    for vehicle in VEHICLES:
        assert np.array_equal(one.poses(vehicle.name, times), other.poses(vehicle.name, times))
        assert one.poses(vehicle.name, times) == pytest.approx(longer.poses(vehicle.name, times), abs=1e-6)


def test_another_seed_gives_another_drive() -> None:
    assert simulate(1).pose("taxi_1", 3) != simulate(2).pose("taxi_1", 3)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32))
def test_vehicles_move_as_vehicles_can(seed: int) -> None:
    step = 0.05
    drive = simulate(seed, 60)
    for vehicle in VEHICLES:
        x, y, yaw = drive.poses(vehicle.name, np.arange(0, 60, step)).T
        moved = np.hypot(np.diff(x), np.diff(y))
        speeds = moved / step
        assert speeds.min() > 4
        assert speeds.max() <= FASTEST + 1e-6
        assert np.abs(np.diff(speeds)).max() / step < ACCELERATION + 0.5
        turned = np.abs(np.remainder(np.diff(yaw) + np.pi, 2 * np.pi) - np.pi)
        assert (turned / step * speeds).max() < 6  # m/s² sideways
        ahead = np.abs(np.remainder(np.arctan2(np.diff(y), np.diff(x)) - yaw[:-1] + np.pi, 2 * np.pi) - np.pi)
        assert ahead.max() < 0.1  # it goes where it looks


def test_every_route_through_the_network_is_smooth() -> None:
    for lane, here in lanes().items():
        assert choices(lane), f"{lane} is a dead end"
        for follower, _ in choices(lane):
            chain = [here, connection(lane, follower), lanes()[follower]]
            for before, after in itertools.pairwise(chain):
                assert before.points[-1] == pytest.approx(after.points[0], abs=1e-9)
                first, second = np.diff(before.points[-2:], axis=0)[0], np.diff(after.points[:2], axis=0)[0]
                cosine = first @ second / np.hypot(*first) / np.hypot(*second)
                assert np.degrees(np.arccos(min(1, cosine))) < 3


def test_the_shuttles_circle_in_opposite_directions() -> None:
    drive = simulate(DEMO_SEED)
    for name, sense in (("shuttle_1", -1), ("shuttle_2", 1)):
        x, y, _ = drive.poses(name, np.arange(0, 60, 0.5)).T
        angles = np.unwrap(np.arctan2(y, x + 330))
        assert np.all(sense * np.diff(angles) > 0)


def test_a_time_beyond_the_horizon_is_refused_with_the_remedy() -> None:
    with pytest.raises(ValueError, match=r"t: 31\.\.31 s is not within the drive's 0\.\.30 s: simulate with a longer"):
        simulate(1, 30).pose("taxi_1", 31)


# What is sent


def test_messages_decode_to_the_simulated_drive() -> None:
    drive = simulate(DEMO_SEED, 2)
    sent = list(messages(drive, START_NS, 2.0))
    assert [message.after_ns for message in sent] == sorted(message.after_ns for message in sent)
    assert Counter(message.type for message in sent) == {POSE_TYPE: 15 * 20, POINTS_TYPE: 6 * 4}
    assert {message.key for message in sent} == set(keys())
    for message in sent:
        decoded: Any = TYPESTORE.deserialize_cdr(message.payload, message.type)
        stamp = decoded.header.stamp.sec * 10**9 + decoded.header.stamp.nanosec
        assert stamp == START_NS + message.after_ns
        name = message.key.split("/")[1]
        if message.type == POSE_TYPE:
            pose = drive.pose(name, message.after_ns / 1e9)
            position, turn = decoded.pose.position, decoded.pose.orientation
            assert decoded.header.frame_id == "map"
            assert (position.x, position.y, position.z) == pytest.approx((pose.x, pose.y, pose.z))
            assert 2 * np.arctan2(turn.z, turn.w) == pytest.approx(pose.yaw)
        else:
            assert decoded.header.frame_id == f"{name}/lidar"
            assert len(decoded.data) == decoded.row_step * decoded.height == decoded.width * decoded.point_step
            assert np.isfinite(decoded.data.view("<f4")).all()


def test_the_messages_over_zenoh_are_the_drive_byte_for_byte() -> None:
    endpoint, drive = free_endpoint(), simulate(DEMO_SEED, 1)
    arrived: list[tuple[str, bytes]] = []
    expected = [(message.key, message.payload) for message in messages(drive, START_NS, 1.0)]
    done: queue.SimpleQueue[None] = queue.SimpleQueue()

    def take(sample: zenoh.Sample) -> None:
        arrived.append((str(sample.key_expr), sample.payload.to_bytes()))
        if len(arrived) == len(expected):
            done.put(None)

    with session("peer", listen__endpoints=[endpoint]) as there:
        subscriber = there.declare_subscriber("vehicles/**", take)
        published = publish(drive, 1.0, connect=[endpoint], start_ns=START_NS, speed=4.0)
        done.get(timeout=PATIENCE)
        subscriber.undeclare()
    assert published.complete
    assert published.listened
    assert published.start_ns == START_NS
    assert (published.messages, published.bytes) == (len(expected), sum(len(payload) for _, payload in expected))
    assert arrived == expected


def test_an_unreachable_endpoint_is_reported() -> None:
    with pytest.raises(UnreachableError, match=r"--connect tcp/127\.0\.0\.1:\d+: no Zenoh session within 0.2 s"):
        publish(simulate(1, 1), 1.0, connect=[free_endpoint()], wait_s=0.2)
    with pytest.raises(UnreachableError, match="--listen here: no Zenoh session"):
        publish(simulate(1, 1), 1.0, listen=["here"])


def test_sigterm_ends_the_drive_gracefully() -> None:
    endpoint = free_endpoint()
    first: queue.SimpleQueue[None] = queue.SimpleQueue()
    with session("peer", listen__endpoints=[endpoint]) as there:
        subscriber = there.declare_subscriber("vehicles/*/pose", lambda _: first.put(None))
        command = [sys.executable, str(EXAMPLE / "drive.py"), "--connect", endpoint, "--duration", "60"]
        drive = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        first.get(timeout=PATIENCE)
        drive.send_signal(signal.SIGTERM)
        out, errors = drive.communicate(timeout=PATIENCE)
        subscriber.undeclare()
    assert (drive.returncode, errors) == (0, "")
    assert out.count("\n") == 1
    assert "stopped early" in out


def test_a_recording_is_the_same_drive_and_opens_as_a_rosbag(tmp_path: Path) -> None:
    drive, file = simulate(DEMO_SEED, 2), tmp_path / "drive.mcap"
    expected = list(messages(drive, START_NS, 2.0))
    assert record(drive, file, 2.0) == len(expected)
    with AnyReader([file]) as reader:
        assert {(c.topic, c.msgtype) for c in reader.connections} == {("/" + m.key, m.type) for m in expected}
        found = [(c.topic, stamp, bytes(raw)) for c, stamp, raw in reader.messages()]
        for connection_, _, raw in reader.messages():
            reader.deserialize(raw, connection_.msgtype)  # the file's own definitions suffice
    assert sorted(found) == sorted(("/" + m.key, START_NS + m.after_ns, m.payload) for m in expected)


# The files


def test_the_rule_compiles_against_the_detector_and_the_detector_selects_it() -> None:
    detector, rule = only(Detector, "town"), only(EventRule, "lidar-vehicles-close")
    assert detector.spec.rule_selector.matches(rule.metadata.labels)
    compiled = compile_rule(rule, detector)
    assert [deploy.template for deploy in compiled.deploys] == ["scene-recorder", "scene-fusion"]


def test_the_expectation_has_the_numbers_of_the_files() -> None:
    rule = only(EventRule, "lidar-vehicles-close").spec
    assert (rule.when, rule.until) == (f"distance < {CLOSE:g}", f"distance > {APART:g}")
    for name in ("scene-recorder", "scene-fusion"):
        assert only(ApplicationTemplate, name).spec.lifecycle.linger.seconds == LINGER


@pytest.mark.parametrize("x", [-300.0, -1.0, 1.0, 300.0])
def test_the_rule_and_the_expectation_use_the_same_place(x: float) -> None:
    compiled = compile_rule(only(EventRule, "lidar-vehicles-close"), only(Detector, "town"))
    ends = [
        {"client": name, "position": {"x": x + shift, "y": 0.0, "z": 0.0}} for name, shift in (("p", -60), ("q", 60))
    ]
    (fuse,) = [deploy for deploy in compiled.deploys if deploy.action == "fuse"]
    parameters = fuse.parameters.render({"a": ends[0], "b": ends[1], "distance": 120.0})
    assert parameters == {"place": place_at(x), "sources": ["p", "q"]}


def test_new_sources_change_the_configuration_but_not_the_deployment() -> None:
    renderer = Renderer(only(ApplicationTemplate, "scene-fusion"), Policy())
    two, three = (
        renderer.render(instance("scene-fusion", key="west", parameters={"place": "west", "sources": sources}))
        for sources in (["p", "q"], ["p", "q", "r"])
    )
    assert two.manifests[0] != three.manifests[0]
    assert two.manifests[1] == three.manifests[1]
    assert three.manifests[0]["data"] == {"sources.yaml": 'place: west\nsources: ["p","q","r"]\n'}


def test_the_recorder_receives_its_two_vehicles() -> None:
    renderer = Renderer(only(ApplicationTemplate, "scene-recorder"), Policy())
    rendered = renderer.render(instance("scene-recorder", key='["p","q"]', parameters={"vehicles": ["p", "q"]}))
    (container,) = rendered.manifests[0]["spec"]["template"]["spec"]["containers"]
    assert container["args"] == ["--key=vehicles/p/**", "--key=vehicles/q/**", "--output=/recording"]


def test_the_picture_is_that_of_the_demo() -> None:
    from picture import svg

    committed = (EXAMPLE / "drive.svg").read_text(encoding="utf-8")
    drawn = svg(simulate(DEMO_SEED), DEMO_DURATION_S)
    assert re.sub(NUMBER, "#", committed) == re.sub(NUMBER, "#", drawn), "run examples/cooperative-recording/picture.py"
    numbers = [[float(number) for number in re.findall(NUMBER, text)] for text in (committed, drawn)]
    assert numbers[0] == pytest.approx(numbers[1], abs=0.2)  # the last digit may differ between processors
    assert len(committed) < 60_000
    ET.fromstring(committed)
