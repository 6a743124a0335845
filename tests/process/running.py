"""A `detector run` process over real Zenoh, for tests: its files, a vehicle that is connected to it, its output."""

from __future__ import annotations

import json
import signal
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zenoh
from prometheus_client.parser import text_string_to_metric_families

from detector.status.model import Status, read_status
from detector.streams.query_handler import NoAnswerError, query_detectors
from tests import programs
from tests.driving import a_detector
from tests.networks import session
from tests.patience import PATIENCE
from tests.ports import free_port
from wayside.api import Kind
from wayside.api.zenoh import Zenoh, ZenohMode


class Process:
    """`detector run` with its own files, and a vehicle that is connected to it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.port = free_port()
        self.network = Zenoh(mode=ZenohMode.CLIENT, connect=[self.endpoint])
        self.name = "d"

    def write(self, *rules: Kind, streams: tuple[dict[str, Any], ...] = (), **spec: Any) -> None:
        # Even on a slow machine, no sample leaves its window and no client is lost.
        lasting = {"buffer": {"duration": "5m"}, "clientTimeout": "5m"}
        detector = a_detector(*streams, zenoh={"listen": [self.endpoint]}, **{**lasting, **spec})
        (self.folder / "detector.yaml").write_text(json.dumps(detector.to_json()))
        (self.folder / "rules.yaml").write_text("\n---\n".join(json.dumps(rule.to_json()) for rule in rules))

    def start(self, *options: str) -> None:
        files = [*options, "--detector", "detector.yaml", "--rules", "rules.yaml", "--metrics-port", str(self.port)]
        self.process = programs.Program(["detector", "run", *files], self.folder / "log", folder=self.folder)
        self.status_when(lambda status: bool(status.rules))
        self.vehicle = session(connect__endpoints=[self.endpoint])

    def send(self, client: str, value: Any, stream: str = "speed") -> None:
        self.vehicle.put(
            f"vehicles/{client}/{stream}",
            json.dumps(value) if not isinstance(value, bytes) else value,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def status_when(self, true: Callable[[Status], bool]) -> Status:
        """The status, once `true` holds for it."""
        end, status = time.monotonic() + PATIENCE, None
        while time.monotonic() < end:
            try:
                (answer,) = query_detectors(self.network, self.name, "status", {}, 5)
            except (NoAnswerError, ValueError):  # the detector is still starting
                time.sleep(0.05)
                continue
            status = read_status(answer.payload)
            if true(status):
                return status
            time.sleep(0.05)
        raise AssertionError(f"not within {PATIENCE} s: {status}\n{(self.folder / 'log').read_text()}")

    def page(self, path: str) -> str:
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}{path}") as answer:
            return str(answer.read().decode())

    def metrics(self) -> dict[tuple[str, ...], float]:
        """By name without prefix, and the values of the labels in the order of their names."""
        return {
            (
                sample.name.removeprefix("wayside_detector_"),
                *(sample.labels[name] for name in sorted(sample.labels)),
            ): sample.value
            for family in text_string_to_metric_families(self.page("/metrics"))
            for sample in family.samples
        }

    def stop(self) -> int:
        """Stop the detector as Kubernetes does; return its exit code."""
        self.vehicle.close()  # type: ignore[no-untyped-call]
        self.process.terminate()
        return self.process.wait(PATIENCE)

    def change(self, *rules: Kind, **spec: Any) -> None:
        self.write(*rules, **spec)
        self.process.send_signal(signal.SIGHUP)

    def written(self) -> list[dict[str, Any]]:
        """The events in the file. A separate thread writes it: events reported elsewhere may not be there yet."""
        whole = (self.folder / "out" / "events.jsonl").read_text().split("\n")[:-1]
        return [json.loads(line) for line in whole]

    def events_when(self, count: int) -> list[dict[str, Any]]:
        """The events in the file once there is this number of them."""
        end = time.monotonic() + PATIENCE
        while len(found := self.written()) < count:
            assert time.monotonic() < end, found
            time.sleep(0.05)
        return found
