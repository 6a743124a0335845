"""Ports for servers that can be stopped and started again on the same one."""

from __future__ import annotations

import random
import socket

# Below Linux's range for outgoing connections (32768 and up): while a server is down, no client's end takes its port.
CANDIDATES = range(20_000, 32_000)


def free_ports(count: int) -> list[int]:
    """Return different loopback TCP ports on which nothing listens now."""
    found: list[int] = []
    for port in random.SystemRandom().sample(CANDIDATES, k=len(CANDIDATES)):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
        found.append(port)
        if len(found) == count:
            return found
    raise RuntimeError(f"no {count} free loopback ports between {CANDIDATES.start} and {CANDIDATES.stop}")


def free_port() -> int:
    """Return one such port."""
    return free_ports(1)[0]


def free_endpoint() -> str:
    """Return a Zenoh endpoint on such a port."""
    return f"tcp/127.0.0.1:{free_port()}"
