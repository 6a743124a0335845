"""The reported health of real detector processes with injected faults."""

from __future__ import annotations

import json
import subprocess
import sys
import urllib.error
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.driving import a_rule, a_stream
from tests.networks import router_process, wait_for
from tests.patience import PATIENCE
from tests.ports import free_endpoint
from tests.process.running import Process

ALWAYS = a_rule("r", signals=[{"name": "v", "stream": "speed", "value": "msg.v"}], when="v > 10")

FAULTS = """
import asyncio, os, sys, threading, time
import detector.live.answers
from detector.commands import cli
from detector.engine.engine import Engine
from detector.live.running import Running

detector.live.answers._SILENT = 1.0

def until_gone(path):
    while os.path.exists(path):
        time.sleep(0.01)

advance = Engine.advance
def stalled(self, *args):
    until_gone("stall-evaluation")
    return advance(self, *args)
Engine.advance = stalled

enter = Running.__enter__
def entered(self):
    async def hang():
        while True:
            until_gone("stall-loop")
            await asyncio.sleep(0.01)
    self.hanging = asyncio.get_running_loop().create_task(hang())
    return enter(self)
Running.__enter__ = entered
sys.exit(cli.main())
"""
"""A detector that stalls while a file exists, as the product itself never does."""


class Faulty(Process):
    """`detector run` with injected faults."""

    def start(self, *options: str) -> None:
        (self.folder / "faulty.py").write_text(FAULTS)
        files = [*options, "--detector", "detector.yaml", "--rules", "rules.yaml", "--metrics-port", str(self.port)]
        log = (self.folder / "log").open("w")
        self.process = subprocess.Popen(
            [sys.executable, "faulty.py", "run", *files], cwd=self.folder, stdout=log, stderr=log
        )

    def health(self, page: str) -> tuple[int, str]:
        try:
            return 200, self.page(page)
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()
        except OSError:  # the detector is still starting
            return 0, ""


@pytest.fixture
def faulty(tmp_path: Path) -> Iterator[Faulty]:
    process = Faulty(tmp_path)
    yield process
    process.process.kill()
    process.process.wait(PATIENCE)


def has(faulty: Faulty, page: str, code: int, text: str) -> Callable[[], bool]:
    def holds() -> bool:
        found = faulty.health(page)
        return found[0] == code and text in found[1]

    return holds


@pytest.mark.parametrize(
    ("fault", "shows"),
    [("stall-evaluation", "the last evaluation was"), ("stall-loop", "the event loop has been blocked for")],
)
def test_a_hanging_thread_makes_the_detector_not_live_until_it_continues(
    faulty: Faulty, fault: str, shows: str
) -> None:
    faulty.write(ALWAYS, streams=(a_stream("speed"),))
    faulty.start()
    wait_for(has(faulty, "/readyz", 200, "the last evaluation"))
    (faulty.folder / fault).touch()
    wait_for(has(faulty, "/healthz", 503, shows))
    wait_for(has(faulty, "/readyz", 503, shows))
    (faulty.folder / fault).unlink()
    wait_for(has(faulty, "/healthz", 200, "the last evaluation"))


def test_an_absent_router_makes_the_detector_unready_but_keeps_it_live(faulty: Faulty, tmp_path: Path) -> None:
    endpoint = free_endpoint()
    faulty.endpoint = endpoint
    faulty.write(ALWAYS, streams=(a_stream("speed"),))
    document = json.loads((tmp_path / "detector.yaml").read_text())
    document["spec"]["zenoh"] = {"mode": "client", "connect": [endpoint]}
    (tmp_path / "detector.yaml").write_text(json.dumps(document))
    faulty.start()
    # On a busy machine, a normal evaluation may also be late by the second that is allowed here.
    wait_for(has(faulty, "/readyz", 503, "no Zenoh session yet"))
    wait_for(has(faulty, "/healthz", 200, "the last evaluation"))
    with router_process(endpoint):
        wait_for(has(faulty, "/readyz", 200, "the last evaluation"))
    wait_for(has(faulty, "/readyz", 503, "nothing is connected"))
    wait_for(has(faulty, "/healthz", 200, "the last evaluation"))
    with router_process(endpoint):
        wait_for(has(faulty, "/readyz", 200, "the last evaluation"))


def test_a_silent_stream_is_healthy(faulty: Faulty) -> None:
    faulty.write(ALWAYS, streams=(a_stream("speed", staleAfter="100ms"),), clientTimeout="100ms")
    faulty.start()
    wait_for(has(faulty, "/readyz", 200, "the last evaluation"))
    wait_for(has(faulty, "/healthz", 200, "the last evaluation"))
