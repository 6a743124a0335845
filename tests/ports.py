"""Ports for servers that can be stopped and started again on the same one."""

from __future__ import annotations

import os
import random
import socket

FIRST, LAST = 20_000, 32_000
"""Below Linux's range for outgoing connections (32768 and up): while a server is down, no client takes its port."""


def candidates() -> range:
    """The ports of this worker: each worker of a test run has its own, so no two find the same one free."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    return range(FIRST + worker, LAST, int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")))


def free_ports(count: int) -> list[int]:
    """Return different loopback TCP ports on which nothing listens now."""
    found: list[int] = []
    ports = candidates()
    for port in random.SystemRandom().sample(ports, k=len(ports)):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
        found.append(port)
        if len(found) == count:
            return found
    raise RuntimeError(f"no {count} free loopback ports between {FIRST} and {LAST}")


def free_port() -> int:
    """Return one such port."""
    return free_ports(1)[0]


def free_endpoint() -> str:
    """Return a Zenoh endpoint on such a port."""
    return f"tcp/127.0.0.1:{free_port()}"
