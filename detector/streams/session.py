"""Zenoh sessions of a Detector: how one is opened, and when its connections open and close."""

from __future__ import annotations

import base64
import json
import logging
import threading
import time

import zenoh

from detector.access import AccessError, LoadedCredentials, read_credentials
from wayside.api.zenoh import Zenoh, ZenohMode
from wayside.inputerror import InputError
from wayside.process.backoff import Backoff, retry

log = logging.getLogger(__name__)

_FIRST, _LONGEST = 0.2, 2.0
"""Seconds between attempts to reach a router at the start."""

_FIELD = "spec.zenoh"


class NetworkError(InputError, ValueError):
    """The Zenoh session cannot be opened with this configuration; the message names the field and the reason."""


def credentials_of(config: Zenoh) -> LoadedCredentials:
    """The current certificates and credentials. Raises NetworkError."""
    try:
        return read_credentials(config, _FIELD)
    except AccessError as error:
        raise NetworkError(str(error)) from error


def open_session(config: Zenoh, credentials: LoadedCredentials | None = None) -> zenoh.Session:
    """Opens a session. A peer or router connects in the background; a client must reach a router now.

    `credentials`: default: that of the configuration. Raises NetworkError.
    """
    try:
        return zenoh.open(_settings(config, credentials_of(config) if credentials is None else credentials))
    except zenoh.ZError as error:
        raise NetworkError(
            f"zenoh: cannot open a session as {config.mode} with connect {[*config.connect]}, listen "
            f"{[*config.listen]}: {error}"
        ) from error


def await_session(config: Zenoh, stop: threading.Event) -> tuple[zenoh.Session, LoadedCredentials] | None:
    """Tries to open a session until it succeeds; None once `stop` is set. Once open, it reconnects by itself."""
    backoff, logged = Backoff(_FIRST, _LONGEST), ""

    def attempt() -> tuple[zenoh.Session, LoadedCredentials] | None:
        if stop.is_set():
            return None
        credentials = credentials_of(config)
        return open_session(config, credentials), credentials

    def failed(error: NetworkError) -> float:
        nonlocal logged
        if str(error) != logged:
            logged = str(error)
            log.warning("%s; retrying", error)
        return backoff.fail()

    return retry(attempt, NetworkError, failed, stop.wait)


class Connections:
    """The connections of a session: logs when the last one is lost, and when one is restored."""

    def __init__(self, session: zenoh.Session) -> None:
        self._lock = threading.Lock()
        self._others: set[str] = set()
        self._alone = False
        self._router_left: float | None = None
        self.departures = 0
        """How often a connection to a router ended."""
        self._closing = False
        self._listener = session.info.declare_transport_events_listener(self._on_transport, history=True)

    @property
    def any(self) -> bool:
        """Whether a router, a peer or a client is connected."""
        return bool(self._others)

    def router_left_within(self, seconds: float) -> bool:
        """Whether a connection to a router ended in the last seconds."""
        left = self._router_left
        return left is not None and time.monotonic() - left <= seconds

    def close(self) -> None:
        """The session closes: do not log the connections that end from now on."""
        self._closing = True

    def _on_transport(self, event: zenoh.TransportEvent) -> None:
        """Called by Zenoh's thread for every connection that opens or closes."""
        other = str(event.transport.zid)
        role = str(event.transport.whatami)
        with self._lock:
            if event.kind == zenoh.SampleKind.PUT:
                self._others.add(other)
                if self._alone:
                    self._alone = False
                    log.info("zenoh: reconnected to %s %s", role, other)
                return
            self._others.discard(other)
            if event.transport.whatami == zenoh.WhatAmI.ROUTER:
                self._router_left = time.monotonic()
                self.departures += 1
            if not self._others and not self._closing:
                self._alone = True
                log.warning("zenoh: lost the last connection, to %s %s; reconnecting", role, other)


def _settings(config: Zenoh, credentials: LoadedCredentials) -> zenoh.Config:
    waits = config.mode is ZenohMode.CLIENT
    values: dict[str, object] = {
        "mode": config.mode.value,
        "connect/endpoints": [*config.connect],
        # A peer keeps trying in the background. A client's open() would not return: `await_session` tries for it.
        "connect/timeout_ms": 0 if waits else -1,
        "connect/exit_on_failure": waits,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 2000, "period_increase_factor": 2},
        "scouting/multicast/enabled": config.scouting,
        "transport/shared_memory/enabled": config.shared_memory,
        **_tls(credentials),
    }
    if config.listen:
        values["listen/endpoints"] = [*config.listen]
        values["listen/exit_on_failure"] = True
    if (login := credentials.login) is not None:
        values["transport/auth/usrpwd/user"] = login.username
        values["transport/auth/usrpwd/password"] = login.password
    settings = zenoh.Config()
    for path, value in values.items():
        settings.insert_json5(path, json.dumps(value))
    return settings


def _tls(credentials: LoadedCredentials) -> dict[str, object]:
    """Contents instead of files: the files may change one after the other while Zenoh reads them."""
    if not credentials.tls:
        return {}
    at = "transport/link/tls/"
    values: dict[str, object] = {f"{at}verify_name_on_connect": credentials.verify_name}
    if credentials.ca is not None:
        values[f"{at}root_ca_certificate_base64"] = _base64(credentials.ca)
    if credentials.certificate is not None and credentials.key is not None:
        certificate, key = _base64(credentials.certificate), _base64(credentials.key)
        values |= {
            f"{at}connect_certificate_base64": certificate,
            f"{at}connect_private_key_base64": key,
            f"{at}listen_certificate_base64": certificate,
            f"{at}listen_private_key_base64": key,
            f"{at}enable_mtls": credentials.ca is not None,
        }
    return values


def _base64(text: bytes) -> str:
    return base64.b64encode(text).decode("ascii")
