"""`detector topics --live`: the keys received over real Zenoh, and a Detector that subscribes to them."""

from __future__ import annotations

import json
import threading

import yaml
import zenoh
from typer.testing import CliRunner

from detector.commands.cli import app
from tests.networks import session
from tests.patience import PATIENCE
from tests.ros_messages import cdr, odometry
from wayside.api import Detector
from wayside.api.stream import Layout

ROS = "0/car1/odom/nav_msgs::msg::dds_::Odometry_/RIHS01_0"


def test_the_streams_of_a_network_are_proposed_and_detectors_are_left_out(endpoint: str) -> None:
    there, over = threading.Event(), threading.Event()

    def drive() -> None:
        with session("peer", listen__endpoints=[endpoint]) as vehicles:
            there.set()
            while not over.wait(0.02):
                for car in ("car1", "car2"):
                    value = json.dumps({"v": 3.5})
                    vehicles.put(f"vehicles/{car}/speed", value, encoding=zenoh.Encoding.APPLICATION_JSON)
                vehicles.put(ROS, cdr(odometry()))
                vehicles.put("wayside/events/d/r/car1", "{}")

    driving = threading.Thread(target=drive)
    driving.start()
    try:
        assert there.wait(PATIENCE)
        listed = CliRunner().invoke(app, ["topics", "--live", "--connect", endpoint, "--seconds", "2"])
        proposed = CliRunner().invoke(app, ["topics", "--live", "--connect", endpoint, "--seconds", "2", "--yaml"])
    finally:
        over.set()
        driving.join()
    assert listed.exit_code == 0, listed.output
    for words in ("vehicles/${client:*}/speed\n  json, 2 clients: car1, car2", "msg.v", "msg.twist.twist.linear.x"):
        assert words in listed.output
    assert "wayside/" not in listed.output
    detector = Detector.model_validate(yaml.safe_load(proposed.output))
    assert detector.spec.zenoh.connect == [endpoint]
    streams = {stream.name: stream for stream in detector.spec.streams}
    assert streams["speed"].key == "vehicles/${client:*}/speed"
    assert (streams["odom"].type, streams["odom"].layout) == ("nav_msgs/msg/Odometry", Layout.RMW_ZENOH)


def test_a_silent_network_is_an_error_with_the_remedy(endpoint: str) -> None:
    with session("peer", listen__endpoints=[endpoint]):
        result = CliRunner().invoke(app, ["topics", "--live", "--connect", endpoint, "--seconds", "0.3"])
    assert f"received nothing from {endpoint} within 0.3 s" in str(result.exception)
    assert CliRunner().invoke(app, ["topics"]).exit_code == 2
