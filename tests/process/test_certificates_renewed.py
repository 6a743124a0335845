"""Certificates are renewed under a running detector: no sample is lost or duplicated, and failures are reported."""

from __future__ import annotations

import datetime
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh

from detector.engine.samples.liveliness import LIVELINESS, TokenState
from detector.streams.session import open_session
from detector.streams.zenoh import Network
from tests.certificates import Authority
from tests.networks import Arrivals, guarded_router, stream, wait_for
from tests.patience import PATIENCE
from tests.ports import free_endpoint
from wayside.api.zenoh import Zenoh

CHECK_EVERY = 0.05
CARS = ("car1", "car2", "car3")


@pytest.fixture
def mounted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("WAYSIDE_SECRETS", str(tmp_path))
    return tmp_path / "own"


@pytest.fixture
def at() -> str:
    return free_endpoint().replace("tcp/127.0.0.1", "tls/localhost")


@contextmanager
def network(arrivals: Arrivals, *streams: Any, **config: Any) -> Iterator[Network]:
    running = Network(
        Zenoh.model_validate({"tlsSecretName": "own", **config}),
        streams or [stream()],
        arrivals.putter,
        check_every=CHECK_EVERY,
    )
    running.start()
    try:
        yield running
    finally:
        running.close()


class Traffic:
    """Vehicles with numbered samples."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._stop = threading.Event()
        self.sent = 0
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Traffic:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(0.001):
            for car in CARS:
                self._session.put(
                    f"vehicles/{car}/pose", str(self.sent), congestion_control=zenoh.CongestionControl.BLOCK
                )
            self.sent += 1


def numbers(arrivals: Arrivals, car: str) -> list[int]:
    return [int(payload) for _, key, payload in arrivals.seen if key == f"vehicles/{car}/pose"]


def certificate_of(authority: Authority, name: str) -> dict[str, Any]:
    certificate, key = authority.sign(name)
    return {"ca": str(authority.ca), "certificate": str(certificate), "key": str(key)}


def client(at: str, authority: Authority, name: str) -> zenoh.Session:
    return open_session(
        Zenoh.model_validate({"mode": "client", "connect": [at], "tls": certificate_of(authority, name)})
    )


@pytest.mark.parametrize("mode", ["client", "peer"])
def test_renewals_under_load_lose_and_duplicate_no_sample(
    mode: str, at: str, authority: Authority, mounted: Path, arrivals: Arrivals
) -> None:
    authority.mount(mounted, "detector")
    with (
        guarded_router(at, authority),
        network(arrivals, mode=mode, connect=[at]) as running,
        client(at, authority, "cars") as vehicles,
    ):
        wait_for(lambda: running.connected)
        subscriber_known = lambda: bool(arrivals.seen)  # noqa: E731
        with Traffic(vehicles) as traffic:
            wait_for(subscriber_known)
            for renewal in range(1, 6):
                authority.mount(mounted, "detector")
                wait_for(lambda renewal=renewal: running.certificate_state.renewals == renewal)
            before = len(arrivals.seen)
            wait_for(lambda: len(arrivals.seen) > before + 300)
        arrivals.wait_for(lambda _: all(numbers(arrivals, car)[-1:] == [traffic.sent - 1] for car in CARS))
        for car in CARS:
            came = numbers(arrivals, car)
            assert came == list(range(came[0], traffic.sent)), f"{car}: each once, in order"
        assert running.certificate_state.problem == ""
        assert running.dead is None


def test_a_certificate_rejected_by_the_router_keeps_the_current_session(
    at: str,
    authority: Authority,
    mounted: Path,
    arrivals: Arrivals,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    authority.mount(mounted, "detector")
    with (
        guarded_router(at, authority),
        network(arrivals, mode="client", connect=[at]) as running,
        client(at, authority, "cars") as vehicles,
        Traffic(vehicles),
    ):
        wait_for(lambda: bool(arrivals.seen))
        stranger = Authority(tmp_path, "stranger").sign("detector")
        foreign = {"tls.crt": stranger[0].read_bytes(), "tls.key": stranger[1].read_bytes()}
        authority.change(mounted, foreign)
        wait_for(lambda: "cannot open a session as client" in running.certificate_state.problem)
        authority.change(mounted, {"tls.crt": b"nonsense", "tls.key": foreign["tls.key"]})
        wait_for(lambda: "are not a certificate and a key" in running.certificate_state.problem)
        authority.change(mounted, foreign | {"tls.key": authority.sign("other")[1].read_bytes()})
        wait_for(lambda: "is not the key of" in running.certificate_state.problem)
        authority.mount(mounted, "detector", lasting=datetime.timedelta(seconds=-60))
        wait_for(lambda: "expired" in running.certificate_state.problem)
        assert running.certificate_state.renewals == 0
        before = len(arrivals.seen)
        wait_for(lambda: len(arrivals.seen) > before + 10)
        assert "keeping the current session" in caplog.text
        assert "PRIVATE KEY" not in caplog.text
        authority.mount(mounted, "detector", lasting=datetime.timedelta(days=30))
        wait_for(lambda: running.certificate_state.renewals == 1)
        assert running.certificate_state.problem == ""
        assert (running.certificate_state.expires or 0) > time.time() + 20 * 86400
    for car in CARS:
        came = numbers(arrivals, car)
        assert came == list(range(came[0], came[-1] + 1))


def test_a_certificate_without_router_permissions_keeps_the_current_session(
    at: str, authority: Authority, mounted: Path, arrivals: Arrivals
) -> None:
    everything = ["put", "declare_subscriber"]
    allowed = {"id": "all", "permission": "allow", "messages": everything, "key_exprs": ["**"]}
    rules = {
        "enabled": True,
        "default_permission": "deny",
        "rules": [allowed],
        "subjects": [{"id": "known", "cert_common_names": ["detector", "cars"]}],
        "policies": [{"rules": ["all"], "subjects": ["known"]}],
    }
    authority.mount(mounted, "detector")
    with (
        guarded_router(at, authority, access_control=rules),
        network(arrivals, mode="client", connect=[at]) as running,
        client(at, authority, "cars") as vehicles,
        Traffic(vehicles),
    ):
        wait_for(lambda: bool(arrivals.seen))
        authority.mount(mounted, "renamed")
        wait_for(lambda: "received nothing" in running.certificate_state.problem)
        before = len(arrivals.seen)
        wait_for(lambda: len(arrivals.seen) > before + 10)
    for car in CARS:
        came = numbers(arrivals, car)
        assert came == list(range(came[0], came[-1] + 1))


def test_tokens_and_latched_samples_are_reported_once(
    at: str, authority: Authority, mounted: Path, arrivals: Arrivals
) -> None:
    latched = stream("map", "maps/${client:*}", history={"samples": 1})
    authority.mount(mounted, "detector")
    with (
        guarded_router(at, authority, timestamping__enabled=True) as source,
        network(arrivals, latched, mode="client", connect=[at], liveliness="alive/${client:*}") as running,
    ):
        publisher = zenoh.ext.declare_advanced_publisher(
            source, "maps/car1", cache=zenoh.ext.CacheConfig(max_samples=1), publisher_detection=True
        )
        publisher.put("first")
        stays = source.liveliness().declare_token("alive/car1")
        goes = source.liveliness().declare_token("alive/car2")
        arrivals.wait_for(lambda seen: len(seen) >= 3)
        authority.mount(mounted, "detector")
        wait_for(lambda: running.certificate_state.renewals == 1)
        goes.undeclare()
        arrivals.wait_for(lambda seen: (LIVELINESS, "alive/car2", TokenState.DROPPED.value) in seen)
        publisher.put("second")
        arrivals.wait_for(lambda seen: ("map", "maps/car1", b"second") in seen)
        assert sorted(arrivals.seen) == sorted(
            [
                ("map", "maps/car1", b"first"),
                (LIVELINESS, "alive/car1", TokenState.DECLARED.value),
                (LIVELINESS, "alive/car2", TokenState.DECLARED.value),
                (LIVELINESS, "alive/car2", TokenState.DROPPED.value),
                ("map", "maps/car1", b"second"),
            ]
        )
        stays.undeclare()


def test_a_detector_that_listens_reopens_its_session_and_stays_as_it_was_with_bad_files(
    at: str, authority: Authority, mounted: Path, arrivals: Arrivals, caplog: pytest.LogCaptureFixture
) -> None:
    authority.mount(mounted, "localhost")
    with network(arrivals, mode="peer", listen=[at]) as running, client(at, authority, "cars") as vehicles:
        with Traffic(vehicles):
            wait_for(lambda: bool(arrivals.seen))
            authority.mount(mounted, "localhost")

            def is_renewed() -> bool:
                running.publish("wayside/events/d/r/s", b"{}")
                return running.certificate_state.renewals == 1

            wait_for(is_renewed)
            before = len(arrivals.seen)
            wait_for(lambda: len(arrivals.seen) > before + 10)
            assert "samples sent in the meantime are lost" in caplog.text
            authority.change(mounted, {"tls.crt": b"nonsense", "tls.key": b"nonsense"})
            wait_for(lambda: "are not a certificate and a key" in running.certificate_state.problem)
            before = len(arrivals.seen)
            wait_for(lambda: len(arrivals.seen) > before + 10)
        for car in CARS:
            came = numbers(arrivals, car)
            assert came == sorted(set(came)), "none twice, none overtaken"
    assert running.dropped_events == 0


def test_a_router_that_is_away_does_not_keep_a_renewal_from_coming_later(
    at: str, authority: Authority, mounted: Path, arrivals: Arrivals
) -> None:
    authority.mount(mounted, "detector")
    with network(arrivals, mode="client", connect=[at]) as running:
        with guarded_router(at, authority):
            wait_for(lambda: running.connected)
        wait_for(lambda: not running.connected)
        authority.mount(mounted, "detector")
        wait_for(lambda: "cannot open a session as client" in running.certificate_state.problem)
        assert running.dead is None
        with guarded_router(at, authority) as source:

            def arrived() -> bool:
                source.put("vehicles/car1/pose", "1")
                return bool(arrivals.seen)

            wait_for(arrived)
            authority.mount(mounted, "detector")
            wait_for(lambda: running.certificate_state.renewals == 1, PATIENCE * 2)
