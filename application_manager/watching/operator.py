"""Registers the watches with kopf; `relay` passes every event on to the router.

Only `on.event`, which neither adds finalizers nor writes to objects. kopf's own Events, peering and progress storage
are off. The API server selects holders' Leases and instances' objects by their labels.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Collection, Iterator
from typing import Any

import kopf

from application_manager.core.objects.labelling import INSTANCE_LABEL
from application_manager.watching.pulse import NEVER, Pulse, pulsing
from application_manager.watching.relay import Handler, Relist, relaying
from wayside.kubernetes.leases import HOLDER_LEASE_LABEL
from wayside.kubernetes.resources import LEASES, Resource
from wayside.process.backoff import Backoff

_FIRST_PAUSE, _LONGEST_PAUSE = 0.1, 1.0  # s between attempts to reach the API server


class _Pauses:
    """An endless series of pauses, which restarts whenever kopf iterates: a watch never gives up."""

    def __iter__(self) -> Iterator[float]:
        backoff = Backoff(_FIRST_PAUSE, _LONGEST_PAUSE)
        while True:
            yield backoff.fail()


async def watch(
    own: Collection[Resource],
    children: Collection[Resource],
    *,
    observe: Handler,
    vanished: Handler,
    relist: Relist,
    failed: Callable[[], None],
    connect: Callable[[], Awaitable[kopf.ConnectionInfo]],
    namespaces: Collection[str],
    ready: asyncio.Event,
    pulse: Pulse,
) -> None:
    """Watch our own kinds, holders' Leases, and objects with an instance's label, until cancelled.

    `namespaces` empty: all. `relist` lists a kind and routes its objects; `failed` counts an object that could not be
    handled. `pulse` receives each watch's signs of life. `ready` is set once kopf has started. `connect` returns
    credentials, at the start and again when the API server no longer accepts them.
    """
    logging.getLogger("kopf").setLevel(logging.WARNING)
    registry = kopf.OperatorRegistry()
    settings = kopf.OperatorSettings()
    settings.posting.enabled = False
    settings.scanning.disabled = True  # the kinds and namespaces are given, so it needs no right to watch CRDs
    settings.networking.error_backoffs = _Pauses()
    settings.networking.request_timeout = 15
    settings.networking.connect_timeout = 5
    settings.watching.inactivity_timeout = NEVER  # see pulse
    settings.watching.chunk_size = 1  # its list is for the version alone, see relay
    settings.process.ultimate_exiting_timeout = None
    settings.queueing.exit_timeout = 0.1  # s; what is lost by stopping at once is seen again at the next start

    async def login(**_: Any) -> kopf.ConnectionInfo:
        return await connect()

    async def handled(**_: Any) -> None:
        """Make kopf watch a kind; the relay handles the events."""

    kopf.on.login(registry=registry)(login)
    for resource in own:
        kopf.on.event(resource.group, resource.version, resource.plural, registry=registry)(handled)
    for resource, label in ((LEASES, HOLDER_LEASE_LABEL), *((each, INSTANCE_LABEL) for each in children)):
        kopf.on.event(resource.group, resource.version, resource.plural, registry=registry)(handled)
        settings.watching.label_selectors[resource.group, resource.version, resource.plural] = label

    identity: Any = "application-manager"  # else kopf looks up the user's name, and a container's may have none
    with pulsing(pulse), relaying(observe, vanished, relist, failed):
        await kopf.operator(
            registry=registry,
            settings=settings,
            identity=identity,
            standalone=True,
            clusterwide=not namespaces,
            namespaces=namespaces,
            ready_flag=ready,
        )
