"""OpenTelemetry spans, if the environment names an OTLP endpoint; otherwise nothing is imported.

    OTEL_EXPORTER_OTLP_ENDPOINT=http://collector:4318   (or OTEL_EXPORTER_OTLP_TRACES_ENDPOINT)

The other settings are standard variables as well, e.g. OTEL_SERVICE_NAME, OTEL_RESOURCE_ATTRIBUTES,
OTEL_TRACES_SAMPLER. Spans are exported after they end, by a separate thread; the caller never waits. At most
OTEL_BSP_MAX_QUEUE_SIZE (2048) spans are queued. Further spans are dropped and counted; spans that the endpoint does not
accept are counted as failed.
"""

from __future__ import annotations

import logging
import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from wayside.process.spans import Tracing

ENDPOINTS = ("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")
PROTOCOLS = ("OTEL_EXPORTER_OTLP_TRACES_PROTOCOL", "OTEL_EXPORTER_OTLP_PROTOCOL")
PROTOCOL = "http/protobuf"
log = logging.getLogger(__name__)


def tracing(service: str, *, export: bool = True) -> Tracing | None:
    """The exporter of spans; None without an endpoint in the environment. A failure to create it is logged.

    Args:
        service: the service name if the environment does not define one.
        export: False: nothing is sent, as in a replay, which only needs the positions of spans.
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
            "sending no traces: %s must be %s; got %s: set it, and use the collector's HTTP port (4318)",
            protocol,
            PROTOCOL,
            environment[protocol],
        )
        return None
    try:
        from wayside.process.spans import Tracing  # noqa: PLC0415  a slow import of an extra
    except ImportError as error:
        log.warning(
            "sending no traces, although %s is set: %s; run pip install 'wayside[otel]', or unset it", endpoint, error
        )
        return None
    return Tracing(service, export=export)
