"""Clients rejected by a router are reported: in its log, and as missing expected clients of the detector."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from detector.streams.session import NetworkError, open_session
from tests.certificates import Authority
from tests.networks import wait_for
from tests.patience import PATIENCE
from tests.ports import free_endpoint
from wayside.api.zenoh import Zenoh

ROUTER = """
import sys, threading, zenoh
zenoh.init_log_from_env_or("info")
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
print("up", flush=True)
threading.Event().wait()
"""

LOG_ALL = "info,zenoh::net::routing::interceptor::access_control=trace"
"""As in docs/security.md."""


class GuardedRouter:
    """A router in a separate process that permits only car1 to publish on its own keys."""

    def __init__(self, folder: Path, log: str) -> None:
        self.authority = Authority(folder)
        self.endpoint = free_endpoint().replace("tcp/127.0.0.1", "tls/localhost")
        certificate, key = self.authority.sign("router")
        tls = {
            "listen_certificate": str(certificate),
            "listen_private_key": str(key),
            "root_ca_certificate": str(self.authority.ca),
            "enable_mtls": True,
        }
        own = {
            "id": "own",
            "permission": "allow",
            "flows": ["ingress"],
            "messages": ["put"],
            "key_exprs": ["vehicles/car1/**"],
        }
        settings: dict[str, Any] = {
            "mode": "router",
            "listen": {"endpoints": [self.endpoint]},
            "scouting": {"multicast": {"enabled": False}},
            "transport": {"link": {"tls": tls}},
            "access_control": {
                "enabled": True,
                "default_permission": "deny",
                "rules": [own],
                "subjects": [{"id": "car1", "cert_common_names": ["car1"]}],
                "policies": [{"rules": ["own"], "subjects": ["car1"]}],
            },
        }
        self._log = folder / "router.log"
        with self._log.open("w") as file:
            self._process = subprocess.Popen(
                [sys.executable, "-c", ROUTER, json.dumps(settings)],
                stdout=file,
                stderr=file,
                env={**os.environ, "RUST_LOG": log},
            )
        wait_for(lambda: "up\n" in self.log)

    @property
    def log(self) -> str:
        return self._log.read_text(errors="replace")  # it may end within a character

    def connect(self, certificate: tuple[Path, Path] | None) -> zenoh.Session:
        own = {} if certificate is None else {"certificate": str(certificate[0]), "key": str(certificate[1])}
        tls = {"ca": str(self.authority.ca), **own}
        return open_session(Zenoh.model_validate({"mode": "client", "connect": [self.endpoint], "tls": tls}))

    def kill(self) -> None:
        self._process.kill()
        self._process.wait(PATIENCE)


@pytest.fixture
def guarded(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[GuardedRouter]:
    router = GuardedRouter(tmp_path, request.param)
    yield router
    router.kill()


@pytest.mark.parametrize("guarded", ["info"], indirect=True)
def test_rejected_and_unauthorized_clients_are_in_the_routers_log(guarded: GuardedRouter, tmp_path: Path) -> None:
    with pytest.raises(NetworkError):
        guarded.connect(None)
    wait_for(lambda: "peer sent no certificates" in guarded.log)
    with pytest.raises(NetworkError):
        guarded.connect(Authority(tmp_path, "stranger").sign("car1"))
    wait_for(lambda: "invalid peer certificate: UnknownIssuer" in guarded.log)
    with pytest.raises(NetworkError):
        guarded.connect((guarded.authority.sign("car1")[0], guarded.authority.sign("car2")[1]))
    with guarded.connect(guarded.authority.sign("unknown")):
        wait_for(lambda: "did not match any configured ACL subject" in guarded.log)


@pytest.mark.parametrize("guarded", [LOG_ALL], indirect=True)
def test_a_foreign_key_is_reported_with_the_name_of_the_certificate(guarded: GuardedRouter) -> None:
    with guarded.connect(guarded.authority.sign("car1")) as car:
        car.put("vehicles/car1/pose", "own")
        car.put("vehicles/car2/pose", "foreign")

        def reported(what: str, key: str) -> bool:
            return any(
                "CertCommonName(car1)" in line and f"{what} to Put (ingress) on {key}" in line
                for line in guarded.log.splitlines()
            )

        wait_for(lambda: reported("is unauthorized", "vehicles/car2/pose"))
        wait_for(lambda: reported("is authorized", "vehicles/car1/pose"))


def test_the_guide_shows_the_tested_log_filter() -> None:
    guide = Path(__file__).parents[2] / "docs" / "security.md"
    assert LOG_ALL in guide.read_text()
