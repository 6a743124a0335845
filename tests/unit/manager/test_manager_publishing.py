"""Configurations on Zenoh, beside the event loop; real sessions, and a connection that a test can cut."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest
import zenoh

from application_manager.work.publishing import Publisher, key_of, settings
from tests.networks import router, wait_for
from tests.patience import PATIENCE
from tests.ports import free_endpoint, free_port
from wayside.kubernetes.connection import ConfigurationError

NAME = ("site", "fusion")
KEY = "wayside/instances/site/fusion/configuration"


class TcpProxy:
    """A TCP connection to somewhere else, that can be cut and mended."""

    def __init__(self, target: int) -> None:
        self.port = free_port()
        self._target = target
        self._open: list[socket.socket] = []
        self._listener: socket.socket | None = None

    def mend(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", self.port))
        threading.Thread(target=self._accept, args=(self._listener,), daemon=True).start()

    def cut(self) -> None:
        assert self._listener is not None
        for each in (self._listener, *self._open):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()
        self._open.clear()

    def _accept(self, listener: socket.socket) -> None:
        with suppress(OSError):
            while True:
                here, _ = listener.accept()
                there = socket.create_connection(("127.0.0.1", self._target))
                self._open += [here, there]
                for one, other in ((here, there), (there, here)):
                    threading.Thread(target=_copy, args=(one, other), daemon=True).start()


def _copy(one: socket.socket, other: socket.socket) -> None:
    with suppress(OSError):
        while data := one.recv(65536):
            other.sendall(data)
        other.shutdown(socket.SHUT_RDWR)


@contextmanager
def running(publisher: Publisher) -> Iterator[Callable[[Callable[[], None]], None]]:
    """The running publisher in a separate event loop; the yielded function runs a call in that loop."""
    calls: list[Any] = []  # the loop, and the task in it
    started, ended = threading.Event(), threading.Event()

    async def work() -> None:
        calls.append(asyncio.get_running_loop())
        calls.append(asyncio.create_task(publisher.run()))
        started.set()
        with suppress(asyncio.CancelledError):
            await calls[1]
        ended.set()

    threading.Thread(target=lambda: asyncio.run(work()), daemon=True).start()
    assert started.wait(PATIENCE)
    try:
        yield calls[0].call_soon_threadsafe
    finally:
        calls[0].call_soon_threadsafe(calls[1].cancel)
        assert ended.wait(PATIENCE)


class Subscriber:
    def __init__(self, session: zenoh.Session) -> None:
        self.contents: list[str | None] = []
        self._subscriber = session.declare_subscriber("wayside/instances/**", self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        deleted = sample.kind == zenoh.SampleKind.DELETE
        self.contents.append(None if deleted else json.loads(sample.payload.to_bytes())["a"])

    def wait_for(self, last: str | None) -> None:
        wait_for(lambda: self.contents[-1:] == [last])


def answers(session: zenoh.Session, key: str) -> list[bytes]:
    return [reply.ok.payload.to_bytes() for reply in session.get(key) if reply.ok is not None]


def test_changes_during_a_lost_connection_are_published_after_it_is_restored() -> None:
    endpoint = free_endpoint()
    wire = TcpProxy(int(endpoint.rpartition(":")[2]))
    with router(listen__endpoints=[endpoint]) as network:
        heard = Subscriber(network)
        publisher = Publisher(settings([f"tcp/127.0.0.1:{wire.port}"]))
        with running(publisher) as call:
            call(lambda: publisher.publish(NAME, {"a": "1"}))
            wire.mend()
            heard.wait_for("1")
            wire.cut()
            call(lambda: publisher.publish(NAME, {"a": "2"}))
            wait_for(lambda: not answers(network, KEY))
            wire.mend()
            heard.wait_for("2")
            call(lambda: publisher.withdraw(NAME))
            heard.wait_for(None)
        wire.cut()


def test_changes_are_published_in_order_and_each_query_answered() -> None:
    endpoint = free_endpoint()
    with router(listen__endpoints=[endpoint]) as network:
        heard = Subscriber(network)
        publisher = Publisher(settings([endpoint]))
        with running(publisher) as call:
            for content in ("1", "1", "2"):
                call(lambda content=content: publisher.publish(NAME, {"a": content}))  # type: ignore[misc]
                heard.wait_for(content)
            # Everything is published again on a new connection; old content never comes back.
            assert [content for content, _ in groupby(heard.contents)] == ["1", "2"]
            call(lambda: publisher.publish(("site", "other"), {"a": "3"}))
            heard.wait_for("3")
            assert answers(network, KEY) == [b'{"a": "2"}']
            assert sorted(answers(network, "wayside/instances/site/*/configuration")) == [b'{"a": "2"}', b'{"a": "3"}']
            assert answers(network, "wayside/instances/elsewhere/*/configuration") == []


def test_without_a_network_nothing_is_kept_and_the_end_is_prompt() -> None:
    silent = Publisher(None)
    with running(silent) as call:
        call(lambda: silent.publish(NAME, {"a": "1"}))
    with running(Publisher(settings([free_endpoint()]))):
        pass  # without a listener, it retries until it is cancelled


def test_the_key_names_namespace_and_instance() -> None:
    assert key_of(NAME) == KEY


@pytest.mark.parametrize("given", [["zenoh:7447"], ["tcp/zenoh:7447", "nowhere"], ["/no/such/file.json5"]])
def test_a_value_that_is_neither_endpoint_nor_file_is_rejected(given: list[str]) -> None:
    with pytest.raises(ConfigurationError, match="--zenoh"):
        settings(given)


def test_a_file_contains_everything(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text('{mode: "peer", connect: {endpoints: ["tcp/127.0.0.1:1"]}}')
    assert json.loads(settings([str(file)]).get_json("mode")) == "peer"
