"""How the detector and the process of a plugin talk: lists of plain data, each with its length before it.

    detector → plugin   start(plugin, parameters)                       → ready() | refused(text)
                        value(subject, element, clients, now)           → queries, then result(value) | failed(text)
                        keep(subjects), reset()                         (no answer)
    plugin → detector   query(method, arguments, options)               → answer(result) | raised(kind, text)

Queries are asked only while a value is computed, one at a time.
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
    """The other side is gone."""


class Wire:
    """One end of the connection."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection

    def send(self, *message: Any, within: float | None = None) -> None:
        """Raises ClosedError, TimeoutError (after so many seconds), and TypeError or OverflowError for strange data."""
        data = _encode(message)
        self._socket.settimeout(within)
        try:
            self._socket.sendall(_LENGTH.pack(len(data)) + data)
        except TimeoutError:
            raise
        except OSError as error:
            raise ClosedError from error

    def receive(self, within: float | None = None) -> list[Any]:
        """The next message. Raises ClosedError, TimeoutError (after so many seconds)."""
        until = None if within is None else time.monotonic() + within
        (size,) = _LENGTH.unpack(self._exactly(_LENGTH.size, until))
        message: list[Any] = _decode(self._exactly(size, until))
        return message

    def close(self) -> None:
        """Hang up."""
        self._socket.close()

    def _exactly(self, size: int, until: float | None) -> bytes:
        parts, missing = [], size
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
            parts.append(part)
            missing -= len(part)
        return b"".join(parts)
