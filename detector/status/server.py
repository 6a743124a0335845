"""/metrics, /healthz and /readyz over HTTP or HTTPS, on separate threads."""

from __future__ import annotations

import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from wayside.process.servingcertificate import EVERY, ServingCertificate

Page = Callable[[], tuple[bool, bytes]]
"""Whether the check succeeded, and the text."""

_TYPE = "text/plain; version=0.0.4; charset=utf-8"

_POLL = 0.1
"""Maximum seconds until the server notices that it is to stop."""

_PATIENCE = 10.0
"""Seconds that a client may take to send its request, so that none occupies a thread forever."""


@dataclass(frozen=True, slots=True)
class PagesAddress:
    """The port of the pages, on all addresses of the machine."""

    port: int
    """0 selects a free one."""
    certificates: Path | None = None
    """The folder with tls.crt and tls.key, which is watched for changes; None: HTTP."""


class StatusServer:
    """Serves pages from `start` to `close`."""

    def __init__(self, address: PagesAddress, pages: Mapping[str, Page]) -> None:
        """Listens at the address.

        Raises:
            OSError: the port is in use.
            CertificateError: the folder contains no valid certificate and key.
        """

        class Handler(BaseHTTPRequestHandler):
            timeout = _PATIENCE

            def do_GET(self) -> None:
                page = pages.get(self.path.partition("?")[0])
                if page is None:
                    self._send(404, f"unknown page; the pages are {', '.join(pages)}\n".encode())
                    return
                well, text = page()
                self._send(200 if well else 503, text)

            def _send(self, status: int, text: bytes) -> None:
                self.send_response(status)
                self.send_header("Content-Type", _TYPE)
                self.send_header("Content-Length", str(len(text)))
                self.end_headers()
                self.wfile.write(text)

            def log_message(self, format: str, *args: object) -> None:  # noqa: A002  the base class names it
                """Log nothing: a probe arrives every few seconds."""

        folder = address.certificates
        certificate = None if folder is None else ServingCertificate(folder, "--metrics-certificates")
        try:
            self._server = _Server(("", address.port), Handler, certificate)
        except OSError as error:
            reason = error.strerror or error
            raise OSError(f"--metrics-port {address.port}: {reason}: give another port") from error
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": _POLL}, name="metrics", daemon=True
        )

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return int(self._server.server_address[1])

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()

    def close(self) -> None:
        """Stop; returns right after the request that is being served."""
        if self._thread.is_alive():
            self._server.shutdown()
            self._thread.join()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(
        self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler], certificate: ServingCertificate | None
    ) -> None:
        self._certificate = certificate
        self._refreshed = time.monotonic()
        super().__init__(address, handler)

    def get_request(self) -> tuple[socket.socket, Any]:
        connection, client = super().get_request()
        if self._certificate is None:
            return connection, client
        # The first read makes the handshake, on the thread of the connection and within its timeout.
        context = self._certificate.context
        return context.wrap_socket(connection, server_side=True, do_handshake_on_connect=False), client

    def service_actions(self) -> None:
        """Called by `serve_forever` at each poll."""
        if self._certificate is not None and time.monotonic() - self._refreshed >= EVERY:
            self._refreshed = time.monotonic()
            self._certificate.refresh()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Do not log clients that close early, or that do not use TLS: these are no errors of the detector."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)
