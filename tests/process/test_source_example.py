"""The example of a third-party source: installed with pip, checked, and run by the detector's own command."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.networks import wait_for
from tests.patience import PATIENCE
from tests.ports import free_port
from tests.process.installing import installed

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "source-plugin"


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, str]:
    """An environment in which the example package is installed."""
    target = installed(EXAMPLE, tmp_path_factory.mktemp("installed"))
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(target), str(ROOT)])}


def detector(*arguments: str | Path) -> list[str | Path]:
    return [sys.executable, "-m", "detector.commands.cli", *arguments]


def test_parameters_of_the_source_plugin_are_checked_with_line_and_column(
    environment: Mapping[str, str], tmp_path: Path
) -> None:
    wrong = tmp_path / "detector.yaml"
    wrong.write_text((EXAMPLE / "detector.yaml").read_text().replace("47808", "99999"))
    files = [EXAMPLE / "rules.yaml"]
    found = subprocess.run(
        detector("check", wrong, *files), env=environment, capture_output=True, text=True, check=False
    )
    assert found.returncode == 1
    assert f"{wrong}:8:26: spec.sources[0].parameters.port: " in found.stderr
    assert "65535" in found.stderr


def test_the_detector_runs_the_source_plugin(environment: Mapping[str, str], tmp_path: Path) -> None:
    port = free_port()
    configuration = tmp_path / "detector.yaml"
    configuration.write_text((EXAMPLE / "detector.yaml").read_text().replace("47808", str(port)))
    command = detector(
        "run", "--detector", configuration, "--rules", EXAMPLE / "rules.yaml", "--output", tmp_path / "out"
    )
    running = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
    events = tmp_path / "out" / "events.jsonl"
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.connect(("127.0.0.1", port))

            def started() -> bool:
                try:
                    sender.send(b"no JSON")
                    sender.send(b'{"key": "sites/north/count", "value": {"vehicles": 12}}')
                except ConnectionRefusedError:  # the source does not listen yet
                    time.sleep(0.05)
                return events.exists() and "north" in events.read_text()

            wait_for(started)
        running.send_signal(signal.SIGTERM)
        _, log = running.communicate(timeout=PATIENCE)
    finally:
        running.kill()
        running.wait()
    assert running.returncode == 0
    assert "crowded north started" in log
