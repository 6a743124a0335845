"""The detector's Zenoh session: mode, endpoints, access and liveliness."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import Field, model_validator

from wayside.api.access import Access
from wayside.api.base import ATOMIC_LIST, Key
from wayside.api.constraints import checked, constraint

Endpoint = Annotated[str, Field(min_length=1, max_length=256, pattern=r"^[a-z]+/.+$")]
"""A Zenoh endpoint such as tcp/zenoh:7447."""

_NO_CLIENT = "liveliness does not capture the client: write ${client:*} in place of its name"


class ZenohMode(StrEnum):
    """How the detector takes part in the Zenoh network."""

    CLIENT = "client"
    PEER = "peer"
    ROUTER = "router"


class Zenoh(Access):
    """The detector's Zenoh session."""

    constraints = (
        *Access.constraints,
        constraint(
            "!has(self.listen) || !self.listen.exists(e, e.startsWith('tls/') || e.startsWith('quic/')) || "
            "has(self.tlsSecretName) || (has(self.tls) && has(self.tls.certificate))",
            "a TLS endpoint in listen needs a certificate: set tls.certificate and tls.key, or tlsSecretName",
            ".listen",
            holds=lambda zenoh: (
                not any(endpoint.startswith(("tls/", "quic/")) for endpoint in zenoh.listen)
                or zenoh.tls_secret_name is not None
                or (zenoh.tls is not None and zenoh.tls.certificate is not None)
            ),
        ),
    )

    mode: ZenohMode = ZenohMode.PEER
    """The mode of the session: client (of a router), peer, or router (others can connect through it)."""
    connect: list[Endpoint] = Field(default_factory=list, max_length=16, json_schema_extra=ATOMIC_LIST)
    """The endpoints to connect to, e.g. tcp/zenoh:7447 or tls/zenoh:7447. Lost connections are re-established."""
    listen: list[Endpoint] = Field(default_factory=list, max_length=16, json_schema_extra=ATOMIC_LIST)
    """The endpoints to listen on, e.g. tcp/0.0.0.0:7447. Default: a free port (peer) or port 7447 (router)."""
    scouting: bool = False
    """If true, the session discovers other Zenoh nodes by multicast."""
    shared_memory: bool = False
    """If true, publishers on the same machine can pass samples in shared memory. The pods must then share /dev/shm."""

    liveliness: Key | None = Field(default=None, json_schema_extra=checked("self.contains('${client:')", _NO_CLIENT))
    """The key expression of the clients' liveliness tokens, e.g. vehicles/${client:*}. A client with a token is known
    even if it sends no data. It is lost as soon as its last token disappears."""

    @model_validator(mode="after")
    def _names_clients(self) -> Zenoh:
        if self.liveliness is not None and "${client:" not in self.liveliness:
            raise ValueError(_NO_CLIENT)
        return self
