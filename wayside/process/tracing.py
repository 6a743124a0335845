"""OpenTelemetry spans, if the environment names an OTLP endpoint; otherwise nothing is imported.

    OTEL_EXPORTER_OTLP_ENDPOINT=http://collector:4318   (or OTEL_EXPORTER_OTLP_TRACES_ENDPOINT)

All else is set by the standard variables too, e.g. OTEL_SERVICE_NAME, OTEL_RESOURCE_ATTRIBUTES, OTEL_TRACES_SAMPLER.
Spans are exported after they end, with their times, and never wait: at most OTEL_BSP_MAX_QUEUE_SIZE (2048) wait for the
exporter, which runs on a thread of its own; what finds them full is dropped and counted, and so is what was not taken.
"""

from __future__ import annotations

import logging
import os
import threading
from typing import TYPE_CHECKING

from wayside.process.tracecontext import Span, TraceContext

if TYPE_CHECKING:
    from wayside.process.spans import Exporting

ENDPOINTS = ("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")
PROTOCOLS = ("OTEL_EXPORTER_OTLP_TRACES_PROTOCOL", "OTEL_EXPORTER_OTLP_PROTOCOL")
PROTOCOL = "http/protobuf"
_PATIENCE = 2.0
"""Seconds that the end of the program waits for the exporter."""

log = logging.getLogger(__name__)


class Tracing:
    """Takes spans, from any thread."""

    def __init__(self, exporting: Exporting) -> None:
        self._exporting = exporting

    def sampled(self, context: TraceContext, name: str) -> bool:
        """Whether the trace that begins with this span is recorded; the result is always the same for a trace."""
        return self._exporting.samples(context, name)

    def emit(self, span: Span) -> TraceContext:
        """Take a span; where it stands. Never waits."""
        return self._exporting.emit(span)

    @property
    def dropped(self) -> int:
        """Spans that found too many waiting."""
        return self._exporting.dropped

    @property
    def failed(self) -> int:
        """Spans that nobody took."""
        return self._exporting.failed

    @property
    def endpoint(self) -> str:
        """The endpoint, for messages."""
        return next((os.environ[each] for each in ENDPOINTS if os.environ.get(each)), "")

    def close(self) -> None:
        """Hand over what waits, for at most two seconds."""
        closing = threading.Thread(target=self._exporting.close, name="spans", daemon=True)
        closing.start()
        closing.join(_PATIENCE)


def tracing(service: str, *, export: bool = True) -> Tracing | None:
    """The exporter of spans; None without an endpoint in the environment. A failure to create it is logged.

    Args:
        service: the service's name where OTEL_SERVICE_NAME gives none.
        export: False: nothing is sent, as in a replay, which only needs the places of spans.
    """
    environment = os.environ
    endpoint = next((each for each in ENDPOINTS if environment.get(each)), None)
    off = (
        environment.get("OTEL_SDK_DISABLED", "").lower() == "true" or environment.get("OTEL_TRACES_EXPORTER") == "none"
    )
    if endpoint is None or off:
        return None
    protocol = next((each for each in PROTOCOLS if environment.get(each)), None)
    if protocol is not None and environment[protocol] != PROTOCOL:
        log.warning(
            "sending no traces: %s is %s, but only %s is supported: set it, with the collector's port for HTTP (4318)",
            protocol,
            environment[protocol],
            PROTOCOL,
        )
        return None
    try:
        from wayside.process.spans import Exporting  # noqa: PLC0415  a slow import of an extra
    except ImportError as error:
        log.warning(
            "sending no traces, although %s is set: %s; pip install 'wayside[otel]', or unset it", endpoint, error
        )
        return None
    return Tracing(Exporting(service, export=export))
