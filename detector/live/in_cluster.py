"""A detector in a cluster: its Detector, rules and tasks are in the API server, and a Lease shows that it is alive.

It begins once it has its rules, its Lease, and the episodes of its live tasks.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from typing import TypeVar

from detector.actions.deploy.kubernetes_store import KubernetesTaskStore
from detector.actions.deploy.lease import HolderLease
from detector.actions.deploy.reconciler import DemandReconciler
from detector.actions.tracing import EpisodeTraces
from detector.live.running import Running, RunOptions
from detector.live.state import state_file, what_was_open
from detector.resources.kubernetes import PROGRAM, ClusterRules
from wayside.kubernetes.connection import connect

Result = TypeVar("Result")
_OTHERWISE = "run without a cluster, with --detector FILE and --rules FILE"


async def run_in_cluster(
    name: str,
    namespace: str | None,
    holder: str,
    options: RunOptions,
    stopping: asyncio.Event,
    traces: EpisodeTraces | None,
) -> None:
    """Run the Detector of that name, and emit its tasks as the holder, until `stopping` is set.

    Raises:
        ConfigurationError, DetectorError, NetworkError, OSError: it cannot start; the message gives the reason.
    """
    async with connect(PROGRAM, namespace, otherwise=_OTHERWISE) as cluster:
        rules = ClusterRules(cluster.client, cluster.namespace, name)
        lease = HolderLease(cluster.client, cluster.namespace, holder)
        store = KubernetesTaskStore(cluster.client, cluster.namespace, holder)
        reconciler = DemandReconciler(store, permitted=lease.held, traces=traces)
        async with asyncio.TaskGroup() as group:
            group.create_task(lease.run())
            try:
                changes = rules.follow()
                first = await _unless(stopping, anext(changes))
                if first is None or await _unless(stopping, lease.held.wait()) is None:
                    return
                state = state_file(first.detector, holder)
                restored = await _unless(stopping, what_was_open(store, state))
                if restored is not None:
                    running = Running(
                        first, holder, reconciler, restored, options, state=state, traces=traces, lease=lease
                    )
                    await running.run(changes, stopping)
            finally:
                lease.stop()


async def _unless(stopping: asyncio.Event, work: Awaitable[Result]) -> Result | None:
    """The work's result, or None if `stopping` is set before."""
    working = asyncio.ensure_future(work)
    ending = asyncio.ensure_future(stopping.wait())
    done, pending = await asyncio.wait({working, ending}, return_when=asyncio.FIRST_COMPLETED)
    for task in pending:
        task.cancel()
    await asyncio.gather(*pending, return_exceptions=True)
    return working.result() if working in done else None
