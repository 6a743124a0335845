"""A trace covers both programs, from the vehicle's event to the readiness of its application."""

from __future__ import annotations

import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests import programs
from tests.cluster.api import Api
from tests.cluster.chain import BUSES, CARS, FAR, HOLDER, NEAR, Chain, Vehicles, rule, template
from tests.cluster.expected_objects import end, start_manager
from tests.cluster.processes import Processes
from tests.cluster.waiting import wait_until
from tests.otlp import Received, Receiver
from tests.patience import PATIENCE
from tests.ports import free_ports
from wayside.times import parse_time

DETECTOR, MANAGER = "wayside-detector", "wayside-application-manager"
MERGED = {"vehicles": {"type": "array", "items": "string", "merge": "Union"}, "rate": {"type": "number", "default": 1}}


@pytest.fixture
def receiver(processes: Processes) -> Iterator[Receiver]:
    """An OTLP receiver for both programs."""
    with Receiver() as running:
        processes.environment |= {"OTEL_EXPORTER_OTLP_ENDPOINT": running.endpoint, "OTEL_BSP_SCHEDULE_DELAY": "100"}
        yield running


def wait_spans(receiver: Receiver, *names: str) -> dict[str, Received]:
    """Wait until exactly one span of each of these names has arrived; return them."""
    found = wait_until(
        lambda: [each for each in receiver.spans() if each.name in names],
        lambda spans: sorted(each.name for each in spans) == sorted(names),
        what=f"the spans {names} have arrived",
    )
    return {each.name: each for each in found}


def replayed(intake: Path, output: Path, environment: dict[str, str]) -> str:
    programs.run("detector", "replay", intake, "--output", output, check=True, environment=environment)
    return (output / "events.jsonl").read_text(encoding="utf-8")


@pytest.mark.usefixtures("kubelet")
def test_a_trace_runs_from_the_event_to_the_readiness(
    chain: Chain, receiver: Receiver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    intake = tmp_path / "intake.mcap"
    program = chain.start("--record-intake", str(intake))
    with Vehicles(chain.endpoint) as vehicles:
        vehicles.place(CARS, NEAR)
        task = chain.wait_task(CARS)
        wait_spans(receiver, "create task record", "reconcile recorder", "apply", "ready")
        vehicles.place(CARS, FAR)
        chain.wait_events(CARS, "started", "Until")
        spans = wait_spans(receiver, "episode close", "create task record", "reconcile recorder", "apply", "ready")
        chain.wait_removed(CARS)
    assert program.terminate() == 0

    episode, created, reconciled = spans["episode close"], spans["create task record"], spans["reconcile recorder"]
    applied, ready = spans["apply"], spans["ready"]
    assert [each.service for each in (episode, created, reconciled, applied, ready)] == [DETECTOR] * 2 + [MANAGER] * 3
    assert {each.trace for each in spans.values()} == {episode.trace}
    parents = [created.parent, reconciled.parent, applied.parent, ready.parent]
    assert (episode.parent, parents) == ("", [episode.id, created.id, reconciled.id, reconciled.id])
    assert not [each for each in spans.values() if each.error is not None]
    started, ended = chain.events(*CARS)
    assert {started["traceparent"], ended["traceparent"]} == {episode.traceparent}
    assert (episode.start, episode.end) == (parse_time(started["time"]), parse_time(ended["time"]))
    assert task["metadata"]["annotations"]["wayside.dev/traceparent"] == created.traceparent
    assert episode.attributes["wayside.subjects"] == list(CARS)
    assert (created.attributes["wayside.rule"], created.attributes["wayside.action"]) == ("close", "record")
    assert reconciled.start <= applied.start <= applied.end <= ready.end

    guide = (Path(__file__).parents[2] / "docs" / "tracing.md").read_text(encoding="utf-8")
    assert not [name for each in spans.values() for name in each.attributes if f"`{name}`" not in guide]
    for name in ("episode <rule>", "create task <action>", "reconcile <template>", "apply", "ready"):
        assert f"`{name}`" in guide

    live = (chain.folder / "events.jsonl").read_text(encoding="utf-8")
    environment = dict(chain.processes.environment)
    assert replayed(intake, tmp_path / "on", environment) == live
    off = {key: value for key, value in environment.items() if not key.startswith("OTEL_")}
    plain = replayed(intake, tmp_path / "off", off)
    assert "traceparent" not in plain
    assert plain == live.replace(f'"traceparent":"{episode.traceparent}",', "")
    assert len(receiver.spans()) == len(spans), "a replay exports no spans"


@pytest.mark.usefixtures("kubelet")
def test_an_episode_that_is_restored_ends_the_same_span(chain: Chain, receiver: Receiver) -> None:
    program = chain.start()
    with Vehicles(chain.endpoint) as vehicles:
        vehicles.place(CARS, NEAR)
        chain.wait_task(CARS)
        created = wait_spans(receiver, "create task record", "ready")["create task record"]
        program.kill9()
        program.start()
        program.wait_for_output(f"Detector {HOLDER} runs")
        vehicles.place(CARS, FAR)
        episode = wait_spans(receiver, "episode close")["episode close"]
    assert (episode.trace, episode.id) == (created.trace, created.parent)
    assert {each["traceparent"] for each in chain.events(*CARS)} == {episode.traceparent}
    wait_spans(receiver, "episode close", "create task record", "ready")  # no span is exported twice


@pytest.mark.usefixtures("kubelet")
def test_a_span_for_several_tasks_is_linked_to_each(chain: Chain, receiver: Receiver) -> None:
    shared = template(linger="300s")
    del shared["spec"]["key"]
    shared["metadata"]["name"] = "fusion"
    shared["spec"]["parameters"] = MERGED
    labels = {"app": "fusion"}
    deployment = shared["spec"]["manifests"][0]
    deployment["metadata"]["labels"] = labels
    deployment["spec"]["selector"]["matchLabels"] = deployment["spec"]["template"]["metadata"]["labels"] = labels
    deploy = {"templateName": "fusion", "parameters": {"vehicles": "${[a.client, b.client]}"}}
    chain.apply(shared, rule(actions=[{"name": "fuse", "deploy": deploy}]))
    chain.start()
    with Vehicles(chain.endpoint) as vehicles:
        vehicles.place(CARS, NEAR)
        first = wait_spans(receiver, "create task fuse", "reconcile fusion", "ready")
        vehicles.place(BUSES, NEAR)
        # Each program exports its own spans: the manager's may arrive before the detector's.
        second = wait_until(
            lambda: [each for each in receiver.spans() if each.trace != first["ready"].trace],
            lambda spans: {"create task fuse", "reconcile fusion", "ready"} <= {each.name for each in spans},
            what="the second trace has arrived",
        )
    created, reconciled = (next(each for each in second if each.name.startswith(name)) for name in ("create", "recon"))
    assert first["reconcile fusion"].links == ()
    assert reconciled.parent == created.id
    assert reconciled.links == ((first["create task fuse"].trace, first["create task fuse"].id),)
    assert reconciled.attributes["wayside.demands"] == 2
    assert [each.name for each in second].count("ready") == 1


def test_a_rejection_and_an_instance_that_never_became_ready_are_failures_in_their_traces(
    chain: Chain, receiver: Receiver, api: Api, processes: Processes
) -> None:
    start_manager(processes, chain.namespace)
    has = {"wayside.dev/traceparent": f"00-{7:032x}-{7:016x}-01"}
    one = {"apiVersion": "wayside.dev/v1alpha1", "kind": "ApplicationTask"}
    waits = {**one, "metadata": {"name": "waits", "annotations": has}}
    api.create({**waits, "spec": {"templateName": "recorder", "parameters": {"vehicles": ["a", "b"]}}})
    wait_spans(receiver, "apply")
    end(api, "waits")
    unready = wait_spans(receiver, "ready")["ready"]
    assert unready.error is not None
    assert unready.error.startswith("NotReady: ")
    wrong = {**one, "metadata": {"name": "wrong", "annotations": has}}
    api.create({**wrong, "spec": {"templateName": "recorder", "parameters": {"vehicles": "a"}}})
    refused = wait_spans(receiver, "refused")["refused"]
    assert refused.error is not None
    assert refused.error.startswith("InvalidParameters: ")
    assert (unready.trace, refused.trace, refused.parent) == (f"{7:032x}", f"{7:032x}", f"{7:016x}")
    unread = {**one, "metadata": {"name": "unread", "annotations": {"wayside.dev/traceparent": "no trace"}}}
    api.create({**unread, "spec": {"templateName": "recorder", "parameters": {"vehicles": ["c", "d"]}}})
    api.wait_for("ApplicationTask", "unread", lambda raw: raw.get("status", {}).get("phase") == "Active", what="served")
    assert not [each for each in receiver.spans() if each.attributes.get("wayside.task") == "unread"]


def counted(port: int, name: str, cause: str) -> float:
    """The counter `name` for the cause in /metrics."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=PATIENCE) as answer:
        families = text_string_to_metric_families(answer.read().decode())
    samples = [sample for family in families for sample in family.samples if sample.name == name]
    return sum(each.value for each in samples if each.labels["cause"] == cause)


@pytest.mark.usefixtures("kubelet")
def test_an_absent_endpoint_delays_nothing_and_dropped_spans_are_counted(chain: Chain, processes: Processes) -> None:
    nobody, of_manager, of_detector = free_ports(3)
    endpoint = {"OTEL_EXPORTER_OTLP_ENDPOINT": f"http://127.0.0.1:{nobody}", "OTEL_EXPORTER_OTLP_TIMEOUT": "1"}
    processes.environment |= {**endpoint, "OTEL_BSP_SCHEDULE_DELAY": "100"}
    manager = start_manager(processes, chain.namespace, "--metrics-port", str(of_manager))
    reported = ["--metrics-port", str(of_detector), "--output", str(chain.folder)]
    program = processes.start("detector", "run", "--name", HOLDER, "--namespace", chain.namespace, *reported)
    with Vehicles(chain.endpoint) as vehicles:
        vehicles.place(CARS, NEAR)
        chain.wait_condition("ApplicationTask", chain.wait_task(CARS)["metadata"]["name"], "Ready", "True")
        vehicles.place(CARS, FAR)
        chain.wait_removed(CARS)
    chain.settled()
    for port, name, cause in (
        (of_manager, "wayside_manager_spans_dropped_total", "failed"),
        (of_detector, "wayside_detector_losses_total", "spans_failed"),
    ):
        wait_until(lambda: counted(port, name, cause), lambda count: count > 0, what=f"{name} counts {cause}")  # noqa: B023  at once
    assert (program.terminate(), manager.terminate()) == (0, 0)
