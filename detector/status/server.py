"""/metrics, /healthz and /readyz over HTTP, on threads of their own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

Page = Callable[[], tuple[bool, bytes]]
"""Whether all is well, and the text."""

_TYPE = "text/plain; version=0.0.4; charset=utf-8"

_POLL = 0.1
"""Maximum seconds until the server notices its stop."""

_PATIENCE = 10.0
"""Seconds that a client may take to send its request, so that none keeps a thread for ever."""


class StatusServer:
    """Serves pages from `start` to `close`."""

    def __init__(self, port: int, pages: Mapping[str, Page]) -> None:
        """Listens on all addresses of the machine; port 0 selects a free one. Raises OSError if the port is in use."""

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
                """Log nothing: a probe comes every few seconds."""

        try:
            self._server = _Server(("", port), Handler)
        except OSError as error:
            raise OSError(f"--metrics-port {port}: {error.strerror or error}: give another port") from error
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": _POLL}, name="metrics", daemon=True
        )

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return int(self._server.server_address[1])

    def start(self) -> None:
        """Begin to answer."""
        self._thread.start()

    def close(self) -> None:
        """End; returns at once after the request that is being answered."""
        if self._thread.is_alive():
            self._server.shutdown()
            self._thread.join()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
