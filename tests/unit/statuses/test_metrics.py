"""A scrape returns a detector's status; liveness and readiness are served over HTTP."""

from __future__ import annotations

import re
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from prometheus_client.core import CounterMetricFamily
from prometheus_client.parser import text_string_to_metric_families

from detector.status.metrics import DETECTOR, RULE, STREAM, Metrics
from detector.status.model import Status
from detector.status.server import PagesAddress, StatusServer
from detector.streams.loss_counter import Cause
from tests.driving import Drive, a_detector, a_rule, a_stream, arrival, at
from tests.guides import guide
from tests.unit.statuses.test_status import FAST, ObservedEngine


def samples(status: Status) -> dict[tuple[str, ...], float]:
    """By name without prefix and values of the labels in order of their names, without the process's own."""
    text = Metrics(lambda: status).text().decode()
    return {
        (sample.name.removeprefix("wayside_detector_"), *sample.labels.values()): sample.value
        for family in text_string_to_metric_families(text)
        if family.name.startswith("wayside_detector_")
        for sample in family.samples
    }


def test_a_scrape_has_the_values_of_the_status() -> None:
    streams = a_stream("pose"), a_stream("speed", stamp="msg.t")
    kept = ObservedEngine(Drive(a_detector(*streams), FAST, a_rule("off", when="true", enabled=False)))
    sent = {"v": 20, "t": at(0.5) / 1e9 - 0.03}
    status = kept.take(arrival(0.5, "car", sent), arrival(0.7, "bus", b"{"), until=1)
    found = samples(status)
    assert found["info", "Wall", "d", "h", status.version] == 1
    assert found["stream_samples_total", "speed"] == 2
    assert found["stream_age_seconds", "speed"] == pytest.approx(0.3)
    assert ("stream_age_seconds", "pose") not in found
    assert found["stream_latency_seconds_bucket", "0.02", "speed"] == 0
    assert found["stream_latency_seconds_bucket", "0.05", "speed"] == 1
    assert found["stream_latency_seconds_count", "speed"] == 1
    assert found["buffer_bytes",] == sum(found["stream_buffered_bytes", name] for name in ("pose", "speed"))
    assert found["rule_evaluations_total", "fast"] == 2
    assert found["rule_episodes_started_total", "fast"] == found["rule_episodes_open", "fast"] == 1
    assert found["rule_state", "fast", "Accepted"] == found["rule_state", "off", "Disabled"] == 1
    assert found["losses_total", "undecodable", "", "speed"] == 1


def test_metrics_have_no_client_label() -> None:
    kept = ObservedEngine(Drive(a_detector(), FAST))
    few = len(samples(kept.take(arrival(0.5, "car", {"v": 20}), until=1)))
    many = kept.take(*(arrival(1.1 + n / 1000, f"car{n}", {"v": 20}) for n in range(100)), until=2)
    assert len(samples(many)) == few


@pytest.fixture
def server() -> Iterator[StatusServer]:
    pages = {"/metrics": lambda: (True, b"some 1\n"), "/readyz": lambda: (False, b"not yet\n")}
    server = StatusServer(PagesAddress(0), pages)
    server.start()
    yield server
    server.close()


def test_pages_are_served_with_503_while_unhealthy(server: StatusServer) -> None:
    def get(path: str) -> tuple[int, str]:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{server.port}{path}") as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()

    assert get("/metrics?x=1") == (200, "some 1\n")
    assert get("/readyz") == (503, "not yet\n")
    assert get("/") == (404, "unknown page; the pages are /metrics, /readyz\n")


def test_a_port_in_use_is_reported_with_the_option(server: StatusServer) -> None:
    with pytest.raises(OSError, match=rf"--metrics-port {server.port}: .*: give another port"):
        StatusServer(PagesAddress(server.port), {})


def test_the_documentation_names_every_metric_and_every_cause() -> None:
    text = guide("operations")
    causes = re.findall(r'cause="([a-z_]+)"', Path("detector/findings/losses.py").read_text())
    names = [f"{name}_total" if kind is CounterMetricFamily else name for name, kind, *_ in (*DETECTOR, *STREAM, *RULE)]
    before = [cause.name.lower() for cause in Cause]
    missing = [
        each
        for each in (*names, *causes, *before, "event_unpublished", "task_changes_total", "task_refusals_total")
        if f"`{each}`" not in text
    ]
    assert len(causes) > 5
    assert missing == []
