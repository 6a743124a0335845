"""The protocol between the detector and a plugin's process: lists of plain data, each preceded by its length.

    detector → plugin   start(plugin, parameters)                       → ready() | refused(text)
                        value(subject, element, clients, now)           → queries, then result(value) | failed(text)
                        retain(subjects), reset()                       (no answer)
    plugin → detector   query(method, arguments, options)               → answer(result) | raised(kind, text)

Queries are sent only while a value is computed, one at a time.
"""

from __future__ import annotations

import socket
import struct
import time
from typing import Any

import msgspec

_LENGTH = struct.Struct(">I")
_encode = msgspec.msgpack.Encoder().encode
_decode = msgspec.msgpack.Decoder().decode


class ClosedError(Exception):
    """The other side has closed the connection."""


class PluginConnection:
    """One end of the connection.

    A message may arrive in pieces, and the time of a `receive` may end in between: the pieces are kept for the next
    call.
    """

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._parts: list[bytes] = []
        self._size: int | None = None

    def send(self, *message: Any, within: float | None = None) -> None:
        """Raises ClosedError, TimeoutError (after `within` seconds), and TypeError or OverflowError for unsupported
        data.
        """
        data = _encode(message)
        self._socket.settimeout(within)
        try:
            self._socket.sendall(_LENGTH.pack(len(data)) + data)
        except TimeoutError:
            raise
        except OSError as error:
            raise ClosedError from error

    def receive(self, within: float | None = None) -> list[Any]:
        """The next message. Raises ClosedError, TimeoutError (after `within` seconds)."""
        until = None if within is None else time.monotonic() + within
        if self._size is None:
            (self._size,) = _LENGTH.unpack(self._exactly(_LENGTH.size, until))
        data, self._size = self._exactly(self._size, until), None
        message: list[Any] = _decode(data)
        return message

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def _exactly(self, size: int, until: float | None) -> bytes:
        missing = size - sum(map(len, self._parts))
        while missing:
            if until is not None:
                left = until - time.monotonic()
                if left <= 0:
                    raise TimeoutError
                self._socket.settimeout(left)
            else:
                self._socket.settimeout(None)
            try:
                part = self._socket.recv(min(missing, 1 << 20))
            except TimeoutError:
                raise
            except OSError as error:
                raise ClosedError from error
            if not part:
                raise ClosedError
            self._parts.append(part)
            missing -= len(part)
        data = b"".join(self._parts)
        self._parts.clear()
        return data
