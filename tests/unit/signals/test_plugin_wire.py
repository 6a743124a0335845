"""Messages between the detector and a plugin's process arrive whole, however they are split."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator

import msgspec
import pytest

from detector.plugins.wire import ClosedError, PluginConnection


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, PluginConnection]]:
    """The one end bare, the other as the detector has it."""
    one, other = socket.socketpair()
    with one, other:
        yield one, PluginConnection(other)


def framed(*message: object) -> bytes:
    data = msgspec.msgpack.encode(message)
    return struct.pack(">I", len(data)) + data


def test_a_partial_message_is_kept_across_timeouts(
    ends: tuple[socket.socket, PluginConnection],
) -> None:
    """A busy machine may well leave the reader no time between a message's length and its content."""
    sender, wire = ends
    for byte in framed("ready"):
        with pytest.raises(TimeoutError):
            wire.receive(0.001)
        sender.send(bytes([byte]))
    assert wire.receive(60) == ["ready"]
    sender.send(framed("result", 7))
    assert wire.receive(60) == ["result", 7]


def test_messages_received_together_are_returned_one_by_one(ends: tuple[socket.socket, PluginConnection]) -> None:
    sender, wire = ends
    sender.send(framed("query", "newest") + framed("result", None))
    assert [wire.receive(60), wire.receive(60)] == [["query", "newest"], ["result", None]]


def test_a_connection_closed_within_a_message_is_an_error(ends: tuple[socket.socket, PluginConnection]) -> None:
    sender, wire = ends
    sender.send(framed("ready")[:-1])
    sender.shutdown(socket.SHUT_WR)
    with pytest.raises(ClosedError):
        wire.receive(60)
