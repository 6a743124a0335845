"""The only module that imports OpenTelemetry: passes completed spans, with given ids, to the SDK's exporter."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Sequence

from opentelemetry import trace
from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import Resource
from opentelemetry.sdk.trace import ReadableSpan, SpanProcessor, TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor, SpanExporter, SpanExportResult
from opentelemetry.sdk.trace.id_generator import IdGenerator, RandomIdGenerator
from opentelemetry.sdk.trace.sampling import Decision

from wayside.process.tracecontext import Span, TraceContext
from wayside.process.tracing import ENDPOINTS

_QUEUE = 2048
"""The SDK's default for OTEL_BSP_MAX_QUEUE_SIZE."""
_PATIENCE = 2.0
"""The seconds for which the program waits for the exporter at its end."""


class _Ids(IdGenerator):
    """Generates the ids that are set for the next span of this thread; otherwise random ids."""

    def __init__(self) -> None:
        self._random = RandomIdGenerator()
        self.next_context = threading.local()

    def generate_trace_id(self) -> int:
        context: TraceContext | None = getattr(self.next_context, "value", None)
        return self._random.generate_trace_id() if context is None else context.trace_id

    def generate_span_id(self) -> int:
        context: TraceContext | None = getattr(self.next_context, "value", None)
        return self._random.generate_span_id() if context is None else context.span_id

    def is_trace_id_random(self) -> bool:
        return False


class _Exporter(SpanExporter):
    """The OTLP exporter, with counts of exported and failed spans."""

    def __init__(self) -> None:
        self._inner = OTLPSpanExporter()
        self.taken = 0
        self.failed = 0

    def export(self, spans: Sequence[ReadableSpan]) -> SpanExportResult:
        self.taken += len(spans)
        result = SpanExportResult.FAILURE
        try:
            result = self._inner.export(spans)
        finally:
            if result is not SpanExportResult.SUCCESS:
                self.failed += len(spans)
        return result

    def shutdown(self) -> None:
        self._inner.shutdown()  # type: ignore[no-untyped-call]


class _Bounded(SpanProcessor):
    """Precedes the SDK's queue. If the queue is full, new spans are dropped and counted, instead of the oldest ones."""

    def __init__(self) -> None:
        self._exporter = _Exporter()
        self._queue = BatchSpanProcessor(self._exporter)
        self._capacity = _capacity()
        self._lock = threading.Lock()
        self._queued = 0
        self.dropped = 0

    @property
    def failed(self) -> int:
        return self._exporter.failed

    def on_end(self, span: ReadableSpan) -> None:
        if span.context is None or not span.context.trace_flags.sampled:
            return
        with self._lock:
            if self._queued - self._exporter.taken >= self._capacity:
                self.dropped += 1
                return
            self._queued += 1
        self._queue.on_end(span)

    def shutdown(self) -> None:
        self._queue.shutdown()  # type: ignore[no-untyped-call]


class Tracing:
    """Exports spans with the SDK, as configured by the standard environment variables. Thread-safe."""

    def __init__(self, service: str, *, export: bool) -> None:
        """`service` is the service name if OTEL_SERVICE_NAME and OTEL_RESOURCE_ATTRIBUTES do not define one."""
        # Failures are counted and reported in the status; the SDK would log each batch.
        logging.getLogger("opentelemetry.exporter").setLevel(logging.CRITICAL)
        own = {} if _names_service() else {"service.name": service}
        self._ids = _Ids()
        self._provider = TracerProvider(resource=Resource.create(own), shutdown_on_exit=False, id_generator=self._ids)
        self._bounded = _Bounded() if export else None
        if self._bounded is not None:
            self._provider.add_span_processor(self._bounded)
        self._tracer = self._provider.get_tracer("wayside")

    @property
    def dropped(self) -> int:
        """The number of spans that were dropped because the queue was full."""
        return self._bounded.dropped if self._bounded is not None else 0

    @property
    def failed(self) -> int:
        """The number of spans that the endpoint did not accept."""
        return self._bounded.failed if self._bounded is not None else 0

    @property
    def endpoint(self) -> str:
        """The endpoint, for messages."""
        return next((os.environ[each] for each in ENDPOINTS if os.environ.get(each)), "")

    def sampled(self, context: TraceContext, name: str) -> bool:
        """Whether the trace that begins with this span is recorded. The result is always the same for a trace."""
        decision = self._provider.sampler.should_sample(None, context.trace_id, name).decision
        return decision is Decision.RECORD_AND_SAMPLE

    def emit(self, span: Span) -> TraceContext:
        """Queue a span, without waiting. Returns its position in the trace."""
        parent = None if span.parent is None else trace.set_span_in_context(_remote(span.parent))
        self._ids.next_context.value = span.context
        try:
            made = self._tracer.start_span(
                span.name,
                context=parent,
                attributes=dict(span.attributes),
                links=[trace.Link(_remote(each).get_span_context()) for each in span.links],
                start_time=span.start,
            )
        finally:
            self._ids.next_context.value = None
        if span.error is not None:
            made.set_status(trace.Status(trace.StatusCode.ERROR, span.error))
        made.end(max(span.start, span.end))
        at = made.get_span_context()
        return TraceContext(at.trace_id, at.span_id, at.trace_flags.sampled)

    def close(self) -> None:
        """Export the queued spans, for at most two seconds."""
        closing = threading.Thread(target=self._provider.shutdown, name="spans", daemon=True)
        closing.start()
        closing.join(_PATIENCE)


def _remote(context: TraceContext) -> trace.NonRecordingSpan:
    flags = trace.TraceFlags(trace.TraceFlags.SAMPLED if context.sampled else trace.TraceFlags.DEFAULT)
    return trace.NonRecordingSpan(
        trace.SpanContext(context.trace_id, context.span_id, is_remote=True, trace_flags=flags)
    )


def _names_service() -> bool:
    attributes = os.environ.get("OTEL_RESOURCE_ATTRIBUTES", "").split(",")
    return bool(os.environ.get("OTEL_SERVICE_NAME")) or any(
        each.partition("=")[0].strip() == "service.name" for each in attributes
    )


def _capacity() -> int:
    try:
        return int(os.environ.get("OTEL_BSP_MAX_QUEUE_SIZE") or _QUEUE)
    except ValueError:
        return _QUEUE  # as in the SDK, which logs it
