"""A simulated ROS 2 node that offers services over real Zenoh, as rmw_zenoh or zenoh-bridge-ros2dds would.

There is no ROS 2 here. It reads requests and writes responses with rosbags, keeps to what rmw_zenoh's servers ask for
(one declares its queryable as complete; a query without payload or attachment is not answered; a number that is still
open is not taken twice), and has fixed type hashes that the tested code did not compute.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Mapping
from typing import Any

import zenoh
from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

HASHES = {
    "std_srvs/srv/Trigger": "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
}

Serve = Callable[[Mapping[str, Any]], Mapping[str, Any] | None]
"""Returns the response to a request; None: no answer."""


class Node:
    """Services on a separate session."""

    def __init__(self, session: zenoh.Session, *, bridged: bool = False, domain: int = 0) -> None:
        self._session = session
        self._bridged = bridged
        self._domain = domain
        self._queryables: list[zenoh.Queryable[None]] = []
        self._changed = threading.Condition()
        self.calls: list[tuple[str, dict[str, Any]]] = []
        """The name and request of each call, also of unanswered ones."""
        self.askers: set[bytes] = set()
        self.numbers: list[int] = []

    def offer(self, name: str, type_name: str, request: str, response: str, serve: Serve, type_hash: str = "*") -> None:
        """Offer a service; the texts are message definitions."""
        store = Typestore()
        package, _, short = type_name.split("/")
        ask, answer = f"{package}/msg/{short}_Request", f"{package}/msg/{short}_Response"
        store.register({**get_types_from_msg(request, ask), **get_types_from_msg(response, answer)})
        key = name.lstrip("/")
        if not self._bridged:
            key = f"{self._domain}/{key}/{package}::srv::dds_::{short}_/{type_hash}"

        def reply(query: zenoh.Query) -> None:
            payload, attachment = query.payload, query.attachment
            if payload is None or (attachment is None and not self._bridged):
                return
            number = 0
            if attachment is not None:
                number, time, length = struct.unpack_from("<qqB", attachment.to_bytes())
                asker = attachment.to_bytes()[17:]
                assert (length, len(asker)) == (16, 16)
                assert time > 0
                assert number not in self.numbers
                self.numbers.append(number)
                self.askers.add(asker)
            message = store.deserialize_cdr(payload.to_bytes(), ask)
            given = {field: getattr(message, field) for field, _ in store.fielddefs[ask][1]}
            given.pop("structure_needs_at_least_one_member", None)
            served = serve(given)
            with self._changed:
                self.calls.append((name, given))
                self._changed.notify_all()
            if served is not None:
                reported = bytes(store.serialize_cdr(store.types[answer](**served), answer))
                here = key if "*" not in key else str(query.key_expr)
                query.reply(here, reported, attachment=attachment)

        self._queryables.append(self._session.declare_queryable(key, reply, complete=not self._bridged))

    def wait_for(self, done: Callable[[list[tuple[str, dict[str, Any]]]], bool], seconds: float = 60) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: done(self.calls), seconds), self.calls

    @property
    def names(self) -> list[str]:
        return [name for name, _ in self.calls]
