"""A TCP proxy before a real server, which a test can cut, hang or make fail on certain data."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress

from tests.mongodb import MongoServer
from tests.ports import free_port


class ServerProxy:
    """Forwards connections from its own port to the server."""

    def __init__(self, server: MongoServer) -> None:
        self._server = server
        self._to = (server.host, server.port)
        self._listener: socket.socket | None = None
        self.port = free_port()  # none that the system gives to outgoing connections while the proxy is cut
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._flowing = threading.Event()
        self._flowing.set()
        self.poison: bytes | None = None
        """A connection that carries these bytes ends."""
        self.restore()

    @property
    def uri(self) -> str:
        """The URI of the server through the proxy, with its credentials and options."""
        login, at, rest = self._server.uri.partition("://")[2].rpartition("@")
        options = rest.partition("?")[2]
        return f"mongodb://{login}{at}127.0.0.1:{self.port}/?{options}{'&' if options else ''}directConnection=true"

    def restore(self) -> None:
        """Let connections through."""
        self._flowing.set()
        if self._listener is not None:
            return
        listener = socket.socket()
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(("127.0.0.1", self.port))
        listener.listen()
        self._listener = listener
        threading.Thread(target=self._accept, args=(listener,), daemon=True).start()

    def cut(self) -> None:
        """Close all connections and refuse new ones."""
        with self._lock:
            listener, self._listener = self._listener, None
            ends = list(self._open)
        if listener is not None:
            listener.shutdown(socket.SHUT_RDWR)
            listener.close()
        self._flowing.set()
        for each in ends:
            _end(each)

    def hang(self) -> None:
        """Accept connections and forward nothing."""
        self._flowing.clear()

    def _accept(self, listener: socket.socket) -> None:
        with suppress(OSError):
            while True:
                near, _ = listener.accept()
                try:
                    far = socket.create_connection(self._to)
                except OSError:
                    _end(near)
                    continue
                with self._lock:
                    stands = self._listener is listener
                    if stands:
                        self._open |= {near, far}
                if not stands:  # cut since it was accepted
                    _end(near)
                    _end(far)
                    continue
                for source, target in ((near, far), (far, near)):
                    threading.Thread(target=self._forward, args=(source, target), daemon=True).start()

    def _forward(self, source: socket.socket, target: socket.socket) -> None:
        tail = b""
        with suppress(OSError):
            while data := source.recv(65536):
                self._flowing.wait()
                if self.poison and self.poison in tail + data:
                    break
                tail = data[-64:]
                target.sendall(data)
        for each in (source, target):
            _end(each)
        with self._lock:
            self._open -= {source, target}


def _end(end: socket.socket) -> None:
    with suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)
    with suppress(OSError):
        end.close()
