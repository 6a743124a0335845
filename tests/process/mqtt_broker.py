"""A real MQTT broker in a separate process that tests can kill, and a publisher."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from amqtt.broker import Broker
from amqtt.plugins.base import BaseAuthPlugin
from amqtt.session import Session
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from tests.patience import PATIENCE

PASSWORD = "open sesame"


class PasswordPlugin(BaseAuthPlugin):
    """Accepts clients with the password, and the tests' publisher."""

    async def authenticate(self, *, session: Session) -> bool:
        return (session.username, session.password) == ("detector", PASSWORD) or session.client_id == "publisher"


@contextmanager
def broker(port: int, *, guarded: bool = False, **listener: Any) -> Iterator[subprocess.Popen[str]]:
    """The broker's process, ready to accept connections; killed at the end."""
    guard = {"tests.process.mqtt_broker.PasswordPlugin": {}}
    anyone = {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}}
    config = {
        "listeners": {"default": {"type": "tcp", "bind": f"127.0.0.1:{port}", **listener}},
        "plugins": guard if guarded else anyone,
    }
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.process.mqtt_broker", json.dumps(config)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        yield process
    finally:
        process.kill()
        process.wait()


@contextmanager
def publisher(port: int, tls: str | None = None) -> Iterator[Client]:
    """A connected client with its own thread."""
    client = Client(CallbackAPIVersion.VERSION2, client_id="publisher")
    if tls is not None:
        client.tls_set(tls)
    client.connect("localhost", port)
    client.loop_start()
    deadline = time.monotonic() + PATIENCE
    while not client.is_connected():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    try:
        yield client
    finally:
        client.disconnect()
        client.loop_stop()


async def _serve(config: dict[str, Any]) -> None:
    await Broker(config).start()
    print("up", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(_serve(json.loads(sys.argv[1])))
