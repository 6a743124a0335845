"""An event loop in a separate thread, like the detector's; the test replaces the engine."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncGenerator, Coroutine, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from tests.patience import PATIENCE
from wayside.kubernetes.client import Client
from wayside.kubernetes.connection import connect

Result = TypeVar("Result")


class Background:
    """Runs coroutines with one connection to the API server."""

    def __init__(self, loop: asyncio.AbstractEventLoop, api: Client):
        self.loop = loop
        self.api = api

    def start(self, work: Coroutine[object, object, Result]) -> Future[Result]:
        """Run the coroutine while the test continues."""
        return asyncio.run_coroutine_threadsafe(work, self.loop)

    def call(self, work: Coroutine[object, object, Result]) -> Result:
        """Run the coroutine and return its result."""
        return self.start(work).result(PATIENCE)


@contextmanager
def background(kubeconfig: Path) -> Iterator[Background]:
    """Start a loop; cancel all its tasks at the end."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, name="background")
    thread.start()
    connection = _connection(kubeconfig)
    try:
        api = asyncio.run_coroutine_threadsafe(anext(connection), loop).result(PATIENCE)
        try:
            yield Background(loop, api)
        finally:
            asyncio.run_coroutine_threadsafe(_cancel_others(), loop).result(PATIENCE)
            asyncio.run_coroutine_threadsafe(connection.aclose(), loop).result(PATIENCE)
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


async def _connection(kubeconfig: Path) -> AsyncGenerator[Client, None]:
    async with connect("wayside-detector", kubeconfig=kubeconfig) as cluster:
        yield cluster.client


async def _cancel_others() -> None:
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for task in others:
        task.cancel()
    await asyncio.gather(*others, return_exceptions=True)
