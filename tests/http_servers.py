"""An HTTP endpoint on a real socket with configurable behaviour, including misbehaviour."""

from __future__ import annotations

import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.patience import PATIENCE


@dataclass(frozen=True)
class Received:
    """One request."""

    method: str
    path: str
    headers: dict[str, str]
    """By lower-case name."""
    body: bytes
    at: float
    """The time of its arrival, by the monotonic clock."""


Behaviour = Callable[["Endpoint", socket.socket, Received], None]
"""Handles a request on the connection's own thread; the connection is closed afterwards."""


def answers(status: int = 200, body: bytes = b"", **headers: str) -> Behaviour:
    """A whole answer."""
    named = {"Content-Length": str(len(body)), **{name.replace("_", "-"): value for name, value in headers.items()}}
    lines = [f"HTTP/1.1 {status} So", *(f"{name}: {value}" for name, value in named.items()), "", ""]
    return lambda _, connection, __: connection.sendall("\r\n".join(lines).encode() + body)


def sends(*pieces: bytes) -> Behaviour:
    """Send these bytes, then close the connection."""

    def send(_: Endpoint, connection: socket.socket, __: Received) -> None:
        for piece in pieces:
            connection.sendall(piece)

    return send


def hangs(after: bytes = b"") -> Behaviour:
    """Send these bytes, then nothing until the test ends."""

    def hang(endpoint: Endpoint, connection: socket.socket, _: Received) -> None:
        connection.sendall(after)
        endpoint.ended.wait(PATIENCE)

    return hang


def first_then(first: Behaviour, then: Behaviour) -> Behaviour:
    """One behaviour for the first request, the other for all later ones."""

    def one_after_the_other(endpoint: Endpoint, connection: socket.socket, request: Received) -> None:
        (first if request is endpoint.requests[0] else then)(endpoint, connection, request)

    return one_after_the_other


def holds(until: threading.Event, then: Behaviour) -> Behaviour:
    """Send nothing until the event is set, then behave like the given behaviour."""

    def hold(endpoint: Endpoint, connection: socket.socket, request: Received) -> None:
        assert until.wait(PATIENCE)
        then(endpoint, connection, request)

    return hold


def drips(begin: bytes, drop: bytes = b"x", every: float = 0.02) -> Behaviour:
    """Send these bytes, then `drop` repeatedly."""

    def drip(endpoint: Endpoint, connection: socket.socket, _: Received) -> None:
        connection.sendall(begin)
        while not endpoint.ended.wait(every):
            connection.sendall(drop)

    return drip


def echoes_headers(status: int = 400) -> Behaviour:
    """An answer that repeats the request's headers."""

    def echo(_: Endpoint, connection: socket.socket, request: Received) -> None:
        body = "\n".join(f"{name}: {value}" for name, value in request.headers.items()).encode()
        answers(status, body)(_, connection, request)

    return echo


class Endpoint:
    """Each request is kept and then treated according to `behaviour`, which may be changed at any time."""

    def __init__(self, behaviour: Behaviour | None = None, context: ssl.SSLContext | None = None) -> None:
        self.behaviour: Behaviour = behaviour or answers()
        self.requests: list[Received] = []
        self.ended = threading.Event()
        self._arrived = threading.Condition()
        self._context = context
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._run, daemon=True).start()

    @property
    def url(self) -> str:
        return f"{'https' if self._context else 'http'}://localhost:{self.port}"

    def received(self, count: int) -> list[Received]:
        """The requests, once this number of them have arrived."""
        with self._arrived:
            assert self._arrived.wait_for(lambda: len(self.requests) >= count, PATIENCE), self.requests
            return list(self.requests)

    def close(self) -> None:
        self.ended.set()
        self._listener.shutdown(socket.SHUT_RDWR)  # otherwise a thread that waits in accept() keeps it open
        self._listener.close()

    def _run(self) -> None:
        while not self.ended.is_set():
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        try:
            if self._context is not None:
                connection = self._context.wrap_socket(connection, server_side=True)
            with connection:
                request = _request(connection)
                with self._arrived:
                    behaviour = self.behaviour  # an observer of the request may change the behaviour for the next
                    self.requests.append(request)
                    self._arrived.notify_all()
                behaviour(self, connection, request)
        except OSError:  # the client has disconnected or rejects the certificate
            connection.close()


def _request(connection: socket.socket) -> Received:
    read = b""
    while b"\r\n\r\n" not in read:
        read += _some(connection)
    head, _, body = read.partition(b"\r\n\r\n")
    first, *lines = head.decode().split("\r\n")
    headers = {name.lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    while len(body) < int(headers.get("content-length", "0")):
        body += _some(connection)
    method, path, _ = first.split(" ")
    return Received(method, path, headers, body, time.monotonic())


def _some(connection: socket.socket) -> bytes:
    read = connection.recv(65536)
    if not read:
        raise ConnectionResetError
    return read


@contextmanager
def endpoint(behaviour: Behaviour | None = None, certificate: tuple[Path, Path] | None = None) -> Iterator[Endpoint]:
    """An endpoint for the duration of a test; with a certificate and its key it uses TLS."""
    context = None
    if certificate is not None:
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        context.load_cert_chain(*certificate)
    made = Endpoint(behaviour, context)
    try:
        yield made
    finally:
        made.close()


@contextmanager
def nobody() -> Iterator[str]:
    """A URL without a listener; its port is reserved meanwhile."""
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        yield f"http://localhost:{held.getsockname()[1]}"


@contextmanager
def endpoint_for(authority: Path, certificate: tuple[Path, Path]) -> Iterator[Endpoint]:
    """A TLS context that requires a client certificate of the authority."""
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=str(authority))
    context.load_cert_chain(*certificate)
    context.verify_mode = ssl.CERT_REQUIRED
    made = Endpoint(None, context)
    try:
        yield made
    finally:
        made.close()
