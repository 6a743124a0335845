"""The path of one task through the manager's modules, from its watch event to the apply of its Deployment.

The manager's parts are wired as in the cluster, over an API server in memory. A visit of a module begins when another
module calls into it, or the event loop does. Calls in a row from one module into another are one visit. These calls are
not counted: calls into the pure core, calls between the cache and its indexes, and calls back into a module that waits
for the caller. Requests to the API server are listed. Exits with 1 where a module is visited more than twice.

    python -m benchmarks.path_of_a_task [--calls]
"""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections import Counter
from collections.abc import Iterator
from contextvars import ContextVar
from types import FrameType
from typing import Any

from benchmarks.reconcile import NAMESPACE, Server, assembly
from benchmarks.task_to_deployment import task
from wayside.kubernetes.resources import Resource
from wayside.kubernetes.workqueue import WorkQueue

PACKAGE = "application_manager."
MOST = 2  # visits of a module

Call = tuple[str, str, str]
"""The module that calls, the module that is called, and the function."""

_on_path: ContextVar[bool] = ContextVar("on the way", default=False)  # tasks inherit it


class Trace:
    """A profile function that notes each call from one module of the manager into another."""

    def __init__(self) -> None:
        self.calls: list[Call] = []
        self._frames: set[FrameType] = set()  # a coroutine that continues is no call

    def __call__(self, frame: FrameType, event: str, argument: Any) -> None:
        """Note a call."""
        if event != "call" or frame in self._frames:
            return
        if frame.f_code is WorkQueue._once.__code__ and frame.f_locals["self"].name == "instance":
            _on_path.set(True)
        if not _is_ours(frame) or not _on_path.get():
            return
        self._frames.add(frame)
        module, callers = _module(frame), list(_callers(frame))
        source = callers[0] if callers else "the event loop"
        internal = _package(module) == "core" or (_package(source) == _package(module) == "cache")
        if module not in callers and not internal:
            self.calls.append((source, module, frame.f_code.co_qualname))

    def visits(self) -> list[Call]:
        """The first call of each visit, in order."""
        found: list[Call] = []
        last: dict[str, str] = {}
        for source, module, function in self.calls:
            if last.get(source) != module:
                found.append((source, module, function))
            last[source] = module
        return found


def _callers(frame: FrameType) -> Iterator[str]:
    """The modules of the manager that wait for the frame, the nearest first."""
    caller = frame.f_back
    while caller is not None:
        if _is_ours(caller):
            yield _module(caller)
        caller = caller.f_back


def _is_ours(frame: FrameType) -> bool:
    return str(frame.f_globals.get("__name__", "")).startswith(PACKAGE)


def _module(frame: FrameType) -> str:
    return str(frame.f_globals["__name__"]).removeprefix(PACKAGE)


def _package(module: str) -> str:
    return module.partition(".")[0]


class TracedServer(Server):
    """An API server in memory that lists requests, and ends the trace at the apply of a Deployment."""

    def __init__(self) -> None:
        super().__init__()
        self.requests: list[str] = []
        self.applied = asyncio.Event()

    async def get(self, resource: Resource, namespace: str, name: str) -> dict[str, Any] | None:
        """Read an object."""
        self.requests.append(f"get {resource.kind}")
        return await super().get(resource, namespace, name)

    async def apply(self, resource: Resource, body: dict[str, Any]) -> dict[str, Any]:
        """Apply an object."""
        self.requests.append(f"apply {resource.kind}")
        if resource.kind == "Deployment":
            sys.setprofile(None)
            self.applied.set()
        return await super().apply(resource, body)


async def traced() -> tuple[Trace, list[str]]:
    """The calls for one task, after another one that loads what is loaded once; and the requests to the API server."""
    server, trace = TracedServer(), Trace()
    made = assembly(server, {})
    running = [asyncio.create_task(each.run()) for each in made.queues]
    for name in ("first", "second"):
        server.requests.clear()
        server.applied.clear()
        raw = task(NAMESPACE, name)
        raw = server.put({**raw, "metadata": {**raw["metadata"], "generation": 1}})
        trace = Trace()
        on_path = _on_path.set(True)
        sys.setprofile(trace)
        made.router.observe(raw)
        _on_path.reset(on_path)
        await server.applied.wait()
        await asyncio.sleep(1.0)  # until statuses are written, which would wake workers of the next trace
    for each in running:
        each.cancel()
    await asyncio.gather(*running, return_exceptions=True)
    await made.close()
    return trace, server.requests


def main() -> int:
    """Print the way; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--calls", action="store_true", help="print each call, not only the first of a visit")
    options = parser.parse_args()
    trace, requests = asyncio.run(traced())
    visits = trace.visits()
    for source, module, function in trace.calls if options.calls else visits:
        print(f"{source:24} → {module:24} {function}")
    print(f"requests up to the Deployment: {', '.join(requests[: requests.index('apply Deployment') + 1])}")
    counts = Counter(module for _, module, _ in visits)
    for module, count in counts.most_common():
        print(f"{count:3} visits of {module}")
    return 0 if max(counts.values()) <= MOST else 1


if __name__ == "__main__":
    sys.exit(main())
