"""The manager's connection to Zenoh when its certificate is renewed: it reconnects with the new files."""

from __future__ import annotations

import asyncio
import datetime
import json
import threading
import time
from pathlib import Path

import pytest

from application_manager.work.publishing import Publisher, settings
from tests.certificates import Authority
from tests.networks import guarded_router, wait_for
from tests.ports import free_endpoint

SHORT = datetime.timedelta(seconds=20)


def test_the_manager_reconnects_with_the_new_certificate_when_the_old_one_expires(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    authority, at = Authority(tmp_path), free_endpoint().replace("tcp/127.0.0.1", "tls/localhost")
    mounted = tmp_path / "own"
    config = {
        "mode": "client",
        "connect": {"endpoints": [at]},
        "scouting": {"multicast": {"enabled": False}},
        "transport": {
            "link": {
                "tls": {
                    "root_ca_certificate": str(mounted / "ca.crt"),
                    "connect_certificate": str(mounted / "tls.crt"),
                    "connect_private_key": str(mounted / "tls.key"),
                    "enable_mtls": True,
                }
            }
        },
    }
    (tmp_path / "zenoh.json5").write_text(json.dumps(config))
    heard: list[tuple[float, str]] = []
    with guarded_router(at, authority) as network:
        kept = network.declare_subscriber(
            "wayside/**", lambda sample: heard.append((time.time(), sample.payload.to_string()))
        )
        authority.mount(mounted, "manager", lasting=SHORT)  # issued last, since it soon expires
        publisher = Publisher(settings([str(tmp_path / "zenoh.json5")]))
        over, going = threading.Event(), threading.Event()

        async def run() -> None:
            running = asyncio.create_task(publisher.run())
            publisher.publish(("site", "fusion"), {"a": "1"})
            going.set()
            await asyncio.to_thread(over.wait)
            publisher.finish()
            await running

        thread = threading.Thread(target=lambda: asyncio.run(run()))
        thread.start()
        try:
            going.wait()
            wait_for(lambda: bool(heard))
            authority.mount(mounted, "manager")

            def lost() -> list[float]:
                return [each.created for each in caplog.records if "zenoh: lost a connection" in each.getMessage()]

            wait_for(lambda: bool(lost()))
            wait_for(lambda: any(at > lost()[0] and text == '{"a": "1"}' for at, text in heard))
        finally:
            over.set()
            thread.join()
        del kept
