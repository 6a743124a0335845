"""Networks for tests: free endpoints, routers, and the arrivals of the detector's streams."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import zenoh

from detector.engine.samples.intake import Put
from tests.certificates import Authority
from tests.patience import PATIENCE
from wayside.api.stream import Encoding, Stream


class Arrivals:
    """The arrivals of the streams, to wait for."""

    def __init__(self) -> None:
        self.seen: list[tuple[str, str, bytes]] = []
        self._changed = threading.Condition()

    def putter(self, *streams: str) -> Put:
        def put(messages: Sequence[tuple[str, bytes]]) -> None:
            with self._changed:
                self.seen += [(stream, key, payload) for key, payload in messages for stream in streams]
                self._changed.notify_all()

        return put

    def wait_for(self, done: Callable[[list[tuple[str, str, bytes]]], bool]) -> None:
        assert self.comes(done, PATIENCE), self.seen

    def comes(self, done: Callable[[list[tuple[str, str, bytes]]], bool], seconds: float) -> bool:
        with self._changed:
            return self._changed.wait_for(lambda: done(self.seen), timeout=seconds)


def stream(name: str = "pose", key: str = "vehicles/${client:*}/pose", **fields: Any) -> Stream:
    return Stream(name=name, key=key, encoding=Encoding.JSON, **fields)


def session(mode: str = "client", **settings: Any) -> zenoh.Session:
    """A Zenoh session without scouting; the paths of settings have __ for /."""
    config = zenoh.Config()
    for path, value in {"mode": mode, "scouting__multicast__enabled": False, **settings}.items():
        config.insert_json5(path.replace("__", "/"), json.dumps(value))
    return zenoh.open(config)


def router(**settings: Any) -> zenoh.Session:
    """A Zenoh router with these settings."""
    return session("router", **settings)


@contextmanager
def guarded_router(at: str, authority: Authority, **more: Any) -> Iterator[zenoh.Session]:
    """A router that accepts only clients with an unexpired certificate of this authority."""
    certificate, key = authority.sign("router")
    tls = {
        "listen_certificate": str(certificate),
        "listen_private_key": str(key),
        "root_ca_certificate": str(authority.ca),
        "enable_mtls": True,
        "close_link_on_expiration": True,
    }
    with router(listen__endpoints=[at], transport__link__tls=tls, **more) as session:
        yield session


_ROUTER = """
import sys, threading, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("listen/endpoints", f'["{sys.argv[1]}"]')
session = zenoh.open(config)
print("up", flush=True)
threading.Event().wait()
"""


@contextmanager
def router_process(endpoint: str) -> Iterator[None]:
    """A Zenoh router in a separate process, which is killed at the end."""
    process = subprocess.Popen([sys.executable, "-c", _ROUTER, endpoint], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        yield
    finally:
        process.kill()
        process.wait()


def wait_for(condition: Callable[[], bool], seconds: float = PATIENCE) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)
