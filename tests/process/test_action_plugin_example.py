"""The example action is installed like a user's package and runs in a real detector over real Zenoh."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import zenoh

from tests.patience import PATIENCE
from tests.process.installing import installed
from tests.process.running import Process

EXAMPLE = Path(__file__).parents[2] / "examples" / "action-plugin"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with the installed package."""
    return installed(EXAMPLE, tmp_path_factory.mktemp("site"))


def check(path: Path | None) -> subprocess.CompletedProcess[str]:
    extra = [] if path is None else [str(path)]
    return subprocess.run(
        [
            sys.executable,
            "-m",
            "detector.commands.cli",
            "check",
            str(EXAMPLE / "detector.yaml"),
            str(EXAMPLE / "rules.yaml"),
        ],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([*extra, *filter(None, sys.path)])},
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_plugin_that_is_not_installed_is_reported_missing(site: Path) -> None:
    missed = check(None)
    assert missed.returncode == 1
    assert "spec.actions[0].plugin.name: no action logbook is installed" in missed.stderr + missed.stdout
    assert check(site).returncode == 0


def test_the_action_writes_its_lines_and_its_outcomes_are_reported_and_counted(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(site), *filter(None, sys.path)]))
    process = Process(tmp_path)
    process.name = "site"
    (tmp_path / "detector.yaml").write_text(
        (EXAMPLE / "detector.yaml").read_text().replace("tcp/127.0.0.1:7447", process.endpoint)
    )
    (tmp_path / "rules.yaml").write_text((EXAMPLE / "rules.yaml").read_text())
    process.start()
    try:
        reported = process.vehicle.declare_subscriber("wayside/actions/**", zenoh.handlers.FifoChannel(16))
        process.send("car1", {"v": 25})
        process.status_when(lambda status: status.rules[0].open == 1)
        process.send("car1", {"v": 5})
        status = process.status_when(lambda status: bool(status.actions) and status.actions[0].done == 1)
        [line] = (tmp_path / "logbook.jsonl").read_text().splitlines()
        written = json.loads(line)
        assert (written["subject"], written["note"], written["samples"]) == ("car1", "car1 goes 25 m/s", 2)
        [action] = status.actions
        assert (action.rule, action.action, action.kind, action.failed) == ("fast", "log", "logbook", 0)
        assert (action.samples, action.files, action.last_file) == (2, 1, "logbook.jsonl")
        follow_up = await_sample(reported)
        document = json.loads(follow_up.payload.to_bytes())
        assert str(follow_up.key_expr) == f"wayside/actions/{status.holder}/fast/{document['data']['episode']}/log"
        assert document["type"] == "dev.wayside.action.done"
        assert document["data"]["files"] == ["logbook.jsonl"]
        assert process.metrics()["action_done_total", "log", "logbook", "fast"] == 1
    finally:
        process.stop()


def await_sample(reported: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]) -> zenoh.Sample:
    end = time.monotonic() + PATIENCE
    while (sample := reported.try_recv()) is None:
        assert time.monotonic() < end
        time.sleep(0.01)
    return sample
