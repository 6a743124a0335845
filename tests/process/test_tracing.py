"""Traces: the episode determines a span's place, no thread waits for the exporter, and disabled tracing is free."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from detector.actions.tracing import episode_traces
from detector.engine.consequences import ActionRun, RunCompleted, RunStarted
from detector.engine.episodes.events import Event
from detector.engine.episodes.record import EpisodeRecord
from detector.engine.episodes.rendering import Rendered
from tests.otlp import Receiver
from tests.patience import PATIENCE
from tests.ports import free_ports
from wayside.process.tracecontext import Span, TraceContext, episode_context, parse_traceparent
from wayside.process.tracing import tracing

CONTEXTS = st.builds(TraceContext, st.integers(1, 2**128 - 1), st.integers(1, 2**64 - 1), st.booleans())


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ignores the machine's variables and exports spans soon; the end waits for the export."""
    monkeypatch.setattr("wayside.process.spans._PATIENCE", PATIENCE)
    for name in ("ENDPOINT", "TRACES_ENDPOINT", "PROTOCOL", "TRACES_PROTOCOL"):
        monkeypatch.delenv(f"OTEL_EXPORTER_OTLP_{name}", raising=False)
    monkeypatch.delenv("OTEL_SDK_DISABLED", raising=False)
    monkeypatch.setenv("OTEL_BSP_SCHEDULE_DELAY", "50")


@given(CONTEXTS)
def test_a_traceparent_reads_back(context: TraceContext) -> None:
    assert parse_traceparent(str(context)) == context


@pytest.mark.parametrize(
    "text",
    [
        None,
        7,
        "",
        "00-" + "0" * 32 + "-" + "1" * 16 + "-01",
        "00-" + "1" * 32 + "-" + "0" * 16 + "-01",
        "01-" + "1" * 32 + "-" + "1" * 16 + "-01",
        "00-" + "A" * 32 + "-" + "1" * 16 + "-01",
        "00-" + "1" * 32 + "-" + "1" * 16 + "-01\n",
    ],
)
def test_an_invalid_traceparent_is_none(text: object) -> None:
    assert parse_traceparent(text) is None


@given(st.text("abcdefgh234567", min_size=1), st.text("abcdefgh234567", min_size=1))
def test_an_episode_has_one_trace_and_its_tasks_a_span_each(one: str, other: str) -> None:
    assert episode_context(one) == episode_context(one)
    assert (episode_context(one).trace_id == episode_context(other).trace_id) == (one == other)
    first, second = episode_context(one).child("task-a"), episode_context(one).child("task-b")
    assert len({episode_context(one).trace_id, first.trace_id, second.trace_id}) == 1
    assert len({episode_context(one).span_id, first.span_id, second.span_id}) == 3


def test_without_an_endpoint_there_are_no_traces_and_nothing_is_imported() -> None:
    script = (
        "import sys, detector.live.service, application_manager.running.service\n"
        "from wayside.process.tracing import tracing\n"
        "assert tracing('x') is None\n"
        "assert not [name for name in sys.modules if name.startswith('opentelemetry')]\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=Path(__file__).parents[2], timeout=PATIENCE)


@pytest.mark.parametrize(("name", "value"), [("OTEL_SDK_DISABLED", "true"), ("OTEL_TRACES_EXPORTER", "none")])
def test_the_standard_variables_turn_traces_off(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:1")
    monkeypatch.setenv(name, value)
    assert tracing("x") is None


def test_an_unsupported_protocol_and_a_missing_extra_are_reported(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:1")
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_PROTOCOL", "grpc")
    assert tracing("x") is None
    assert "OTEL_EXPORTER_OTLP_PROTOCOL must be http/protobuf; got grpc" in caplog.text
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_PROTOCOL", "http/protobuf")
    monkeypatch.setitem(sys.modules, "wayside.process.spans", None)  # as if it could not be imported
    assert tracing("x") is None
    assert "pip install 'wayside[otel]'" in caplog.text


def test_spans_arrive_with_their_ids_times_links_and_failures(monkeypatch: pytest.MonkeyPatch) -> None:
    with Receiver() as receiver:
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", receiver.endpoint)
        reported = tracing("of-a-test")
        assert reported is not None
        root, other = episode_context("one"), episode_context("two")
        assert reported.emit(Span("episode", 10, 90, context=root, attributes={"subjects": ["a", "b"]})) == root
        made = reported.emit(Span("apply", 20, 30, parent=root, links=[other], error="no such kind"))
        assert made.trace_id == root.trace_id
        reported.close()
        first, second = receiver.spans()
    assert (first.service, first.name, first.start, first.end) == ("of-a-test", "episode", 10, 90)
    assert (first.traceparent, first.parent, first.error) == (str(root), "", None)
    assert first.attributes == {"subjects": ["a", "b"]}
    assert (second.trace, second.parent, second.error) == (first.trace, first.id, "no such kind")
    assert second.links == ((f"{other.trace_id:032x}", f"{other.span_id:016x}"),)


def test_the_service_may_be_named_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    with Receiver() as receiver:
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", receiver.endpoint)
        monkeypatch.setenv("OTEL_RESOURCE_ATTRIBUTES", "site=north,service.name=ours")
        reported = tracing("theirs")
        assert reported is not None
        reported.emit(Span("episode", 10, 90))
        reported.close()
        assert [each.service for each in receiver.spans()] == ["ours"]


def test_spans_beyond_the_queue_are_dropped_and_counted_and_the_rest_arrives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OTEL_BSP_MAX_QUEUE_SIZE", "8")
    monkeypatch.setenv("OTEL_BSP_MAX_EXPORT_BATCH_SIZE", "1")
    with Receiver() as receiver:
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", receiver.endpoint)
        receiver.hold()
        reported = tracing("x")
        assert reported is not None
        reported.emit(Span("first", 1, 2))
        assert receiver.requested.wait(PATIENCE)
        for number in range(50):
            reported.emit(Span(f"later {number}", 3, 4))
        assert reported.dropped == 50 - 8
        receiver.release()
        reported.close()
    assert reported.failed == 0
    assert len(receiver.spans()) == 1 + 8


def test_spans_for_an_absent_endpoint_are_dropped_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    (port,) = free_ports(1)
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", f"http://127.0.0.1:{port}")
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_TIMEOUT", "0.1")
    reported = tracing("x")
    assert reported is not None
    reported.emit(Span("lost", 1, 2))
    reported.close()
    assert reported.failed == 1


def test_events_and_the_input_of_actions_have_the_trace_of_their_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:1")
    event = Event("town", EpisodeRecord("e", "close", "a+b", ("a", "b"), None, 1, 2, {}, None), {})
    run = ActionRun("close", "notify", "e")
    with episode_traces(export=False) as traces:
        assert traces is not None
        marked = traces.event(event)
        begun, completed = traces.consequences([RunStarted(run, event, Rendered(), False), RunCompleted(run)])
    assert marked.cloud_event()["traceparent"] == str(episode_context("e"))
    assert begun == RunStarted(run, marked, Rendered(), False)
    assert completed == RunCompleted(run)
    assert "traceparent" not in event.cloud_event()


def test_the_unsampled_flag_is_propagated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OTEL_TRACES_SAMPLER", "always_off")
    with Receiver() as receiver:
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", receiver.endpoint)
        with episode_traces() as traces:
            assert traces is not None
            context = episode_context("one")
            assert not traces.tracing.sampled(context, "episode")
            traces.tracing.emit(Span("episode", 1, 2, context=context))
        assert receiver.spans() == []
