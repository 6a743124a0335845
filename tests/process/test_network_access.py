"""The detector in protected networks: TLS, mutual TLS, passwords; and shared memory."""

import asyncio
import re
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
from pydantic import ValidationError

from detector.access import AccessError, Login, login, tls_files
from detector.actions.deploy.file_store import FileTaskStore
from detector.actions.deploy.reconciler import DemandReconciler
from detector.engine.samples.liveliness import LIVELINESS, TokenState
from detector.live.running import Running, RunOptions
from detector.live.state import RestoredState
from detector.resources.selection import RuleSet
from detector.streams.session import NetworkError, open_session
from detector.streams.zenoh import Network
from tests.certificates import Authority
from tests.driving import a_detector
from tests.networks import Arrivals, router, router_process, stream, wait_for
from tests.patience import PATIENCE
from tests.ports import free_endpoint
from wayside.api.access import Access
from wayside.api.zenoh import Zenoh, ZenohMode


def tls_router(endpoint: str, authority: Authority, *, mutual: bool = False) -> Any:
    certificate, key = authority.sign("router")
    return router(
        listen__endpoints=[endpoint],
        transport__link__tls={
            "listen_certificate": str(certificate),
            "listen_private_key": str(key),
            "root_ca_certificate": str(authority.ca),
            "enable_mtls": mutual,
        },
    )


@contextmanager
def network(arrivals: Arrivals, **config: Any) -> Iterator[Network]:
    running = Network(Zenoh.model_validate(config), [stream()], arrivals.putter)
    running.start()
    try:
        yield running
    finally:
        running.close()


def flows(source: zenoh.Session, arrivals: Arrivals, payload: Any = "x", within: float = PATIENCE) -> bool:
    """Whether a put sample arrives."""
    deadline = time.monotonic() + within
    while not arrivals.seen:
        if time.monotonic() > deadline:
            return False
        source.put("vehicles/car1/pose", payload() if callable(payload) else payload)
        time.sleep(0.01)
    return True


def over_tls(endpoint: str, protocol: str = "tls") -> str:
    return endpoint.replace("tcp/127.0.0.1", f"{protocol}/localhost")


@pytest.mark.parametrize("protocol", ["tls", "quic"])
def test_data_flows_encrypted(protocol: str, endpoint: str, arrivals: Arrivals, authority: Authority) -> None:
    at = over_tls(endpoint, protocol)
    with (
        tls_router(at, authority) as source,
        network(arrivals, mode="client", connect=[at], tls={"ca": str(authority.ca)}),
    ):
        assert flows(source, arrivals)


def test_a_router_whose_certificate_another_authority_signed_is_refused(
    endpoint: str,
    authority: Authority,
    tmp_path: Path,
) -> None:
    at, stranger = over_tls(endpoint), Authority(tmp_path, "stranger")
    with tls_router(at, authority):
        config = Zenoh.model_validate({"mode": "client", "connect": [at], "tls": {"ca": str(stranger.ca)}})
        with pytest.raises(NetworkError, match=re.escape(at)):
            open_session(config)


def test_with_mtls_only_clients_with_a_certificate_connect(
    endpoint: str,
    arrivals: Arrivals,
    authority: Authority,
) -> None:
    at = over_tls(endpoint)
    certificate, key = authority.sign("detector")
    with tls_router(at, authority, mutual=True) as source:
        with network(arrivals, mode="client", connect=[at], tls={"ca": str(authority.ca)}) as without:
            assert not flows(source, arrivals, within=1)
            assert not without.connected
        own = {"ca": str(authority.ca), "certificate": str(certificate), "key": str(key)}
        with network(arrivals, mode="client", connect=[at], tls=own) as welcome:
            assert flows(source, arrivals)
            wait_for(lambda: welcome.connected)


def test_a_peer_listens_with_tls_and_requires_certificates(
    endpoint: str,
    arrivals: Arrivals,
    authority: Authority,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Here all files are in a Secret's folder."""
    at = over_tls(endpoint)
    monkeypatch.setenv("WAYSIDE_SECRETS", str(tmp_path))
    certificate, key = authority.sign("both")
    (tmp_path / "certs").mkdir()
    for source, name in ((authority.ca, "ca.crt"), (certificate, "tls.crt"), (key, "tls.key")):
        (tmp_path / "certs" / name).write_bytes(source.read_bytes())
    with network(arrivals, mode="peer", listen=[at], tlsSecretName="certs"):
        client = Zenoh.model_validate({"mode": "client", "connect": [at], "tlsSecretName": "certs"})
        with open_session(client) as vehicle:
            assert flows(vehicle, arrivals)
        without = Zenoh.model_validate({"mode": "client", "connect": [at], "tls": {"ca": str(authority.ca)}})
        with pytest.raises(NetworkError):
            open_session(without).close()


def test_only_the_right_password_opens_a_router_that_requires_one(
    endpoint: str,
    arrivals: Arrivals,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    dictionary = tmp_path / "users.txt"
    dictionary.write_text("detector:open sesame\nrouter:itself\n")
    auth = {"user": "router", "password": "itself", "dictionary_file": str(dictionary)}
    credentials = {"username": "detector", "passwordVariable": "ZENOH_PASSWORD"}
    with router(listen__endpoints=[endpoint], transport__auth__usrpwd=auth) as source:
        monkeypatch.setenv("ZENOH_PASSWORD", "close sesame")
        with network(arrivals, mode="client", connect=[endpoint], credentials=credentials) as wrong:
            assert not flows(source, arrivals, within=1)
            assert not wrong.connected
            wait_for(lambda: "cannot open a session" in caplog.text)
        monkeypatch.setenv("ZENOH_PASSWORD", "open sesame")
        with network(arrivals, mode="client", connect=[endpoint], credentials=credentials):
            assert flows(source, arrivals)
    assert "sesame" not in caplog.text


def test_the_routers_access_control_limits_the_received_keys(endpoint: str, arrivals: Arrivals) -> None:
    rules = {
        "enabled": True,
        "default_permission": "allow",
        "rules": [
            {
                "id": "closed",
                "permission": "deny",
                "messages": ["put"],
                "flows": ["egress"],
                "key_exprs": ["vehicles/car1/**"],
            }
        ],
        "subjects": [{"id": "all"}],
        "policies": [{"rules": ["closed"], "subjects": ["all"]}],
    }
    with (
        router(listen__endpoints=[endpoint], access_control=rules) as source,
        network(arrivals, mode="client", connect=[endpoint]),
    ):
        deadline = time.monotonic() + PATIENCE
        while not arrivals.seen and time.monotonic() < deadline:
            source.put("vehicles/car1/pose", "closed")
            source.put("vehicles/car2/pose", "open")
    assert {key for _, key, _ in arrivals.seen} == {"vehicles/car2/pose"}


def test_samples_in_shared_memory_arrive(endpoint: str, arrivals: Arrivals) -> None:
    provider = zenoh.shm.ShmProvider.default_backend(1 << 20)

    def in_shared_memory() -> zenoh.shm.ZShmMut:
        buffer = provider.alloc(100_000, policy=zenoh.shm.BlockOn(zenoh.shm.GarbageCollect()))
        buffer[:] = bytes([7]) * 100_000
        return buffer

    with (
        router(listen__endpoints=[endpoint]) as source,
        network(arrivals, mode="client", connect=[endpoint], sharedMemory=True),
    ):
        assert flows(source, arrivals, in_shared_memory)
        assert arrivals.seen[0] == ("pose", "vehicles/car1/pose", bytes([7]) * 100_000)
        for shares in (True, False):
            other = Zenoh.model_validate({"mode": "client", "connect": [endpoint], "sharedMemory": shares})
            with open_session(other) as session:
                subscriber = session.declare_subscriber("vehicles/*/pose")
                while (sample := subscriber.try_recv()) is None:
                    source.put("vehicles/car1/pose", in_shared_memory())
                    time.sleep(0.01)
                assert (sample.payload.as_shm() is not None) == shares


def test_a_killed_router_is_reported_and_so_is_its_return(
    endpoint: str, arrivals: Arrivals, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    client = Zenoh(mode=ZenohMode.CLIENT, connect=[endpoint])
    with network(arrivals, mode="client", connect=[endpoint], liveliness="alive/${client:*}") as running:
        with router_process(endpoint):
            vehicle = open_session(client)
            token = vehicle.liveliness().declare_token("alive/car1")
            assert flows(vehicle, arrivals)
            wait_for(lambda: running.connected)
            arrivals.wait_for(lambda seen: (LIVELINESS, "alive/car1", TokenState.DECLARED.value) in seen)
        wait_for(lambda: not running.connected)
        wait_for(lambda: "lost the last connection" in caplog.text)
        arrivals.wait_for(lambda seen: (LIVELINESS, "alive/car1", TokenState.UNSURE.value) in seen)
        arrivals.seen.clear()
        with router_process(endpoint):
            arrivals.wait_for(lambda seen: seen == [(LIVELINESS, "alive/car1", TokenState.DECLARED.value)])
            arrivals.seen.clear()
            assert flows(vehicle, arrivals)
            wait_for(lambda: running.connected)
            wait_for(lambda: "reconnected" in caplog.text)
        token.undeclare()
        vehicle.close()


def test_a_running_detector_moves_to_another_network_with_its_buffer(endpoint: str, tmp_path: Path) -> None:
    other = free_endpoint()

    def at(where: str) -> RuleSet:
        return RuleSet(a_detector(buffer={"duration": "1h"}, zenoh={"mode": "client", "connect": [where]}), ())

    async def changes() -> AsyncIterator[RuleSet]:
        yield at(other)

    async def live() -> None:
        reconciler = DemandReconciler(FileTaskStore(tmp_path, "h"))
        with Running(at(endpoint), "h", reconciler, RestoredState(), RunOptions()) as running:

            def buffered(client: str) -> bool:
                with open_session(
                    Zenoh(mode=ZenohMode.CLIENT, connect=[other if client == "car2" else endpoint])
                ) as car:
                    car.put(f"vehicles/{client}/pose", "{}")
                return client in [each.name for each in running.answers.status().clients]

            await asyncio.to_thread(wait_for, lambda: buffered("car1"))
            await running.follow(changes())
            await asyncio.to_thread(wait_for, lambda: buffered("car2"))
            status = running.answers.status()
            assert [each.name for each in status.clients] == ["car1", "car2"]
            assert status.streams[0].clients == 2

    with router(listen__endpoints=[endpoint]), router(listen__endpoints=[other]):
        asyncio.run(live())


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({"tls": {"ca": "missing.crt"}}, "spec.zenoh.tls.ca: cannot read missing.crt: No such file"),
        ({"tlsSecretName": "absent"}, "spec.zenoh.tlsSecretName: the Secret absent is not mounted at"),
        (
            {"credentials": {"username": "u", "passwordVariable": "WAYSIDE_UNSET"}},
            "spec.zenoh.credentials.passwordVariable: the environment variable WAYSIDE_UNSET is not set",
        ),
        (
            {"credentials": {"username": "u", "passwordFile": "missing"}},
            "spec.zenoh.credentials.passwordFile: cannot read missing",
        ),
    ],
)
def test_missing_files_are_reported_by_field(given: dict[str, Any], problem: str) -> None:
    config = Zenoh.model_validate({"connect": ["tcp/127.0.0.1:1"], "listen": ["tcp/127.0.0.1:0"], **given})
    with pytest.raises(NetworkError, match=re.escape(problem)):
        open_session(config)


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({"tls": {"certificate": "a"}}, "give both certificate and key, or neither"),
        ({"tls": {}, "tlsSecretName": "a"}, "give tls or tlsSecretName"),
        ({"listen": ["tls/0.0.0.0:7447"]}, "needs a certificate"),
        ({"credentials": {"username": "u"}}, "give exactly one of passwordVariable and passwordFile"),
        ({"credentials": {"username": "u", "password": "secret"}}, "password"),
    ],
)
def test_invalid_settings_are_rejected(given: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValidationError, match=problem):
        Zenoh.model_validate(given)


def test_a_secret_is_a_folder_and_a_password_is_never_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WAYSIDE_SECRETS", str(tmp_path))
    folder = tmp_path / "login"
    folder.mkdir()
    (folder / "username").write_text("detector\n")
    access = Access.model_validate({"credentialsSecretName": "login", "tlsSecretName": "login"})
    with pytest.raises(AccessError, match=r"cannot read .*password"):
        login(access, "spec.zenoh")
    (folder / "password").write_text("sesame\n")
    found = login(access, "spec.zenoh")
    assert found == Login("detector", "sesame")
    assert "sesame" not in repr(found)
    with pytest.raises(AccessError, match=r"spec\.zenoh\.tlsSecretName: cannot read .*ca\.crt"):
        tls_files(access, "spec.zenoh")
