"""Worker processes of a Dask cluster: on a laptop, on Slurm, or on Kubernetes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from distributed import Client, as_completed
from distributed.scheduler import KilledWorker

from detector.mining.workers import ATTEMPTS, LostWorker, RemoteCall
from wayside.inputerror import InputError

_PATIENCE = 60
"""Seconds for the first worker to join."""


class ClusterError(InputError, RuntimeError):
    """A Dask cluster that cannot be used; the text names the reason and the remedy."""


class DaskWorkers:
    """The workers of a cluster. They access the recordings and the folder of clips by the same paths."""

    def __init__(self, address: str) -> None:
        """`address` is the scheduler's, e.g. tcp://127.0.0.1:8786. Raises ClusterError."""
        try:
            self._client = Client(address, timeout=_PATIENCE)  # type: ignore[no-untyped-call]
        except (OSError, ValueError) as error:
            start = "start one with `dask scheduler`"
            raise ClusterError(f"--dask {address}: there is no scheduler ({error}): {start}") from error
        try:
            self._client.wait_for_workers(1, timeout=_PATIENCE)
        except TimeoutError as error:
            self.close()
            raise ClusterError(f"--dask {address}: it has no worker: start one with `dask worker {address}`") from error

    @property
    def count(self) -> int:
        """See `Workers`."""
        return sum(self._client.nthreads().values())  # type: ignore[no-untyped-call]

    def run(self, calls: Iterable[RemoteCall]) -> Iterator[tuple[RemoteCall, Any]]:
        """See `Workers`. The scheduler reassigns a dead worker's calls, up to its `allowed-failures`."""
        running = {self._client.submit(*call, pure=False, retries=ATTEMPTS): call for call in calls}
        for future in as_completed([*running]):  # type: ignore[no-untyped-call]
            call = running.pop(future)
            try:
                result = future.result()
            except KilledWorker as error:
                result = LostWorker(
                    f"its worker was killed each time, e.g. for lack of memory: {error.last_worker.address}"
                )
            yield call, result
            future.release()  # the cluster need not keep it

    def close(self) -> None:
        """See `Workers`."""
        self._client.close()  # type: ignore[no-untyped-call]
