"""The chart's router configuration in a real Zenoh router: the rights of each client, by its certificate."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.certificates import Authority
from tests.helm import ensure_tools
from tests.helm.wayside_chart import Helm, HelmError
from tests.networks import wait_for
from tests.ports import free_port

CLIENTS = [
    {"name": "vehicles", "commonNames": ["car1", "car2"], "publish": ["vehicles/{commonName}/**"]},
    {"name": "detectors", "commonNames": ["town"], "subscribe": ["vehicles/**"], "publish": ["wayside/events/**"],
     "answer": ["wayside/detectors/**"]},
    {"name": "applications", "commonNames": ["fusion"], "subscribe": ["vehicles/*/points"], "publish": ["scenes/**"]},
    {"name": "operators", "commonNames": ["anna"], "subscribe": ["wayside/events/**"], "ask": ["wayside/detectors/**"]},
]  # fmt: skip
TLS = {"secretName": "router-tls"}


@pytest.fixture
def helm(tmp_path: Path) -> Helm:
    return Helm(ensure_tools().helm, tmp_path / "home")


def configuration(helm: Helm, **router: Any) -> dict[str, Any]:
    rendered = helm.rendered({"router": {"enabled": True, "tls": TLS} | router})
    found: dict[str, Any] = json.loads(rendered.one("ConfigMap", "wayside-router")["data"]["router.json"])
    return found


Connect = Callable[..., zenoh.Session]


@dataclass(frozen=True)
class GuardedRouter:
    """The router's own session, and a function that connects clients to it."""

    router: zenoh.Session
    connect: Connect


@pytest.fixture
def connect(guarded: GuardedRouter) -> Connect:
    return guarded.connect


@pytest.fixture
def guarded(helm: Helm, tmp_path: Path) -> Iterator[GuardedRouter]:
    """Connects with a certificate for this name, optionally from another authority, or without one."""
    authority, other = Authority(tmp_path), Authority(tmp_path, "foreign")
    certificate, key = authority.sign("router")
    port = free_port()
    made = configuration(helm, accessControl={"clients": CLIENTS})
    assert made["listen"]["endpoints"] == ["tls/0.0.0.0:7447"]
    made["listen"]["endpoints"] = [f"tls/127.0.0.1:{port}"]
    tls = made["transport"]["link"]["tls"]
    files = {"listen_certificate": certificate, "listen_private_key": key, "root_ca_certificate": authority.ca}
    assert {each: tls[each] for each in files} == {
        "listen_certificate": "/tls/tls.crt", "listen_private_key": "/tls/tls.key", "root_ca_certificate": "/tls/ca.crt"
    }  # fmt: skip
    tls |= {each: str(path) for each, path in files.items()}
    sessions = []

    def connected(name: str | None, *, foreign: bool = False) -> zenoh.Session:
        patience = 60_000 if name is not None and not foreign else 3000  # ms: who is let in is waited for
        mine: dict[str, Any] = {"root_ca_certificate": str(authority.ca), "verify_name_on_connect": True}
        if name is not None:
            signed = (other if foreign else authority).sign(name)
            mine |= {"connect_certificate": str(signed[0]), "connect_private_key": str(signed[1]), "enable_mtls": True}
        sessions.append(
            opened(
                {
                    "mode": "client",
                    "connect": {
                        "endpoints": [f"tls/localhost:{port}"],
                        "timeout_ms": patience,
                        "exit_on_failure": True,
                    },
                    "scouting": {"multicast": {"enabled": False}},
                    "transport": {"link": {"tls": mine}},
                }
            )
        )
        return sessions[-1]

    with closing(opened(made)) as inside:
        yield GuardedRouter(inside, connected)
        for each in sessions:
            each.close()  # type: ignore[no-untyped-call]


def opened(settings: dict[str, Any]) -> zenoh.Session:
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


def test_each_client_can_do_only_what_it_is_permitted_to(connect: Connect) -> None:
    car, town, anna = connect("car1"), connect("town"), connect("anna")
    listening = connect("town")  # a session receives its own puts without the router
    at_town: list[str] = []
    at_anna: list[str] = []
    listening.declare_subscriber("**", lambda sample: at_town.append(f"wide {sample.key_expr}"))
    listening.declare_subscriber("vehicles/**", lambda sample: at_town.append(str(sample.key_expr)))
    anna.declare_subscriber("vehicles/**", lambda sample: at_anna.append(str(sample.key_expr)))
    anna.declare_subscriber("wayside/events/**", lambda sample: at_anna.append(str(sample.key_expr)))
    town.declare_queryable("wayside/detectors/town/status", lambda query: query.reply(query.key_expr, "fine"))

    def put(session: zenoh.Session, key: str) -> None:
        session.put(key, b"x")

    def arrives() -> bool:
        put(car, "vehicles/car1/pose")
        put(car, "wayside/events/town/forged")  # rejected, in contrast to the puts around it
        put(town, "wayside/events/town/rule")
        put(town, "vehicles/car1/forged")
        return "vehicles/car1/pose" in at_town and "wayside/events/town/rule" in at_anna

    wait_for(arrives)
    for _ in range(20):
        arrives()
    assert set(at_town) <= {"vehicles/car1/pose", "wide vehicles/car1/pose"}, "a wide query returns no more"
    assert set(at_anna) == {"wayside/events/town/rule"}

    def reported(session: zenoh.Session) -> list[str]:
        replies = session.get("wayside/detectors/*/status", timeout=1.0)
        return [reply.ok.payload.to_string() for reply in replies if reply.ok is not None]

    wait_for(lambda: reported(anna) == ["fine"])
    assert reported(car) == []


EVENT, STATUS = "wayside/events/town/r/s", "wayside/detectors/town/status"
MAY: dict[str, dict[str, set[str]]] = {
    "car1": {"publishes": {"vehicles/car1/pose", "vehicles/car1/points"}},
    "town": {
        "publishes": {EVENT},
        "receives": {"vehicles/car1/pose", "vehicles/car2/pose", "vehicles/car1/points"},
        "answers": {STATUS, "wayside/detectors/other/status"},
    },
    "fusion": {"publishes": {"scenes/north"}, "receives": {"vehicles/car1/points"}},
    "anna": {"receives": {EVENT}, "queries": {STATUS, "wayside/detectors/other/status"}},
    "stranger": {},
}
"""The router rejects all other attempts below. A client that may publish on a key may also declare a token there."""

KEYS = (
    "vehicles/car1/pose", "vehicles/car2/pose", "vehicles/car1/points", EVENT, STATUS, "wayside/detectors/other/status",
    "wayside/instances/n/i/configuration", "scenes/north", "anything",
)  # fmt: skip


@pytest.mark.parametrize("who", MAY)
def test_each_client_reaches_only_its_own_keys(guarded: GuardedRouter, who: str) -> None:
    """Observed by the router's own session, which has no access control."""
    inside, session = guarded.router, guarded.connect(who)
    reached: dict[str, set[str]] = {each: set() for each in ("publishes", "token", "receives", "queries", "answers")}

    def noting(what: str, by: str) -> Callable[[zenoh.Sample], None]:
        return lambda each: reached[what].add(str(each.key_expr)) if each.payload.to_string() == by else None

    kept: list[Any] = [inside.declare_subscriber("**", noting("publishes", "theirs"))]
    kept.append(inside.liveliness().declare_subscriber("**", lambda each: reached["token"].add(str(each.key_expr))))
    for key in KEYS:
        kept.append(session.declare_subscriber(key, noting("receives", "ours")))
        kept.append(session.liveliness().declare_token(key))
        kept.append(inside.declare_queryable(key, lambda query: query.reply(query.key_expr, "ours")))
        kept.append(session.declare_queryable(key, lambda query: query.reply(query.key_expr, "theirs")))

    def ask(asking: zenoh.Session, key: str, by: str) -> bool:
        replies = asking.get(key, timeout=0.3, target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE)
        return any(reply.ok is not None and reply.ok.payload.to_string() == by for reply in replies)

    def try_all() -> bool:
        for key in KEYS:
            session.put(key, "theirs")
            inside.put(key, "ours")
            if ask(session, key, "ours"):
                reached["queries"].add(key)
            if ask(inside, key, "theirs"):
                reached["answers"].add(key)
        return reached["token"] >= MAY[who].get("publishes", set()) and all(
            keys <= reached[what] for what, keys in MAY[who].items()
        )

    wait_for(try_all)
    try_all()  # all permitted messages have arrived; the others had as much time
    expected = {what: MAY[who].get(what, set()) for what in reached}
    assert reached == expected | {"token": expected["publishes"]}


@pytest.mark.parametrize("who", [{"name": None}, {"name": "car1", "foreign": True}])
def test_a_client_without_a_certificate_is_refused(connect: Connect, who: dict[str, Any]) -> None:
    connect("car1")
    with pytest.raises(zenoh.ZError):
        connect(who["name"], foreign=who.get("foreign", False))


def test_invalid_values_are_rejected_with_the_remedy(helm: Helm) -> None:
    with pytest.raises(HelmError, match=r"give router\.tls\.secretName .* or router\.tls\.issuerRef"):
        helm.rendered({"router": {"enabled": True}})
    with pytest.raises(HelmError, match=r"router\.accessControl knows clients by their certificates"):
        configuration(helm, tls=TLS | {"mutual": False})


def test_a_common_name_with_a_key_wildcard_is_rejected(helm: Helm) -> None:
    clients = [{"name": "vehicles", "commonNames": ["car*"], "publish": ["vehicles/{commonName}/**"]}]
    with pytest.raises(HelmError, match=r'the common name "car\*" of vehicles cannot stand in a key'):
        configuration(helm, accessControl={"clients": clients})


def test_additional_router_configuration_can_be_given(helm: Helm) -> None:
    made = configuration(
        helm, configuration={"adminspace": {"enabled": True}, "transport": {"unicast": {"max_links": 2}}}
    )
    assert made["adminspace"]["enabled"] is True
    assert made["transport"]["unicast"]["max_links"] == 2
    assert made["transport"]["link"]["tls"]["enable_mtls"] is True
    zenoh.Config.from_json5(json.dumps(made))
