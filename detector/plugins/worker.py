"""The process of one plugin signal: `python -m detector.plugins.worker FD`.

It only responds; the detector answers its queries from the buffer while it waits for the value.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any

import msgspec

from detector.engine.queries.geometry import Pose, PoseError
from detector.engine.queries.queries import DecodedSample, QueryError
from detector.engine.queries.transforms import TransformError
from detector.plugins.base import PluginSubject
from detector.plugins.entrypoints import PluginError
from detector.plugins.instances import Instances, failure_text
from detector.plugins.wire import ClosedError, PluginConnection

_RAISED = {kind.__name__: kind for kind in (TransformError, PoseError, QueryError)}

_Samples = list[DecodedSample]


class RemoteQueries:
    """The queries of Queries, sent to the detector."""

    def __init__(self, wire: PluginConnection, now: int) -> None:
        self._wire = wire
        self._now = now

    @property
    def now(self) -> int:
        """See Queries."""
        return self._now

    def clients(self) -> list[str]:
        """See Queries."""
        found: list[str] = self._query(list[str], "clients")
        return found

    def streams(self, client: str) -> list[str]:
        """See Queries."""
        found: list[str] = self._query(list[str], "streams", client)
        return found

    def newest(self, client: str | None, stream: str, *, frame: str | None = None) -> DecodedSample | None:
        """See Queries."""
        found: DecodedSample | None = self._query(DecodedSample | None, "newest", client, stream, frame=frame)
        return found

    def last(self, client: str | None, stream: str, count: int, *, frame: str | None = None) -> list[DecodedSample]:
        """See Queries."""
        found: _Samples = self._query(_Samples, "last", client, stream, count, frame=frame)
        return found

    def between(
        self, client: str | None, stream: str, after: int, until: int, *, frame: str | None = None
    ) -> list[DecodedSample]:
        """See Queries."""
        found: _Samples = self._query(_Samples, "between", client, stream, after, until, frame=frame)
        return found

    def nearest(self, client: str | None, stream: str, stamp: int, *, frame: str | None = None) -> DecodedSample | None:
        """See Queries."""
        found: DecodedSample | None = self._query(DecodedSample | None, "nearest", client, stream, stamp, frame=frame)
        return found

    def pose(self, client: str, stream: str, stamp: int, *, at: str = "") -> Pose | None:
        """See Queries."""
        found: Pose | None = self._query(Pose | None, "pose", client, stream, stamp, at=at)
        return found

    def tuples(self, client: str, streams: Sequence[str], slop: int) -> list[tuple[DecodedSample, ...]]:
        """See Queries."""
        found: list[tuple[DecodedSample, ...]] = self._query(
            list[tuple[DecodedSample, ...]], "tuples", client, list(streams), slop
        )
        return found

    def transform(self, client: str, target: str, source: str, stamp: int | None = None) -> Pose:
        """See Queries."""
        found: Pose = self._query(Pose, "transform", client, target, source, stamp)
        return found

    def _query(self, kind: Any, method: str, *arguments: Any, **options: Any) -> Any:
        self._wire.send("query", method, arguments, options)
        answer, *content = self._wire.receive()
        if answer == "raised":
            name, text = content
            raise _RAISED.get(name, QueryError)(text)
        return msgspec.convert(content[0], kind)


def _serve(wire: PluginConnection) -> None:
    """Respond until the detector closes the connection."""
    _, plugin, parameters = wire.receive()
    try:
        instances = Instances(plugin, parameters)
    except PluginError as error:
        wire.send("refused", str(error))
        return
    except Exception as error:  # noqa: BLE001  a plugin's warm_up may raise any exception
        wire.send("refused", failure_text(error))
        return
    wire.send("ready")
    while True:
        what, *content = wire.receive()
        match what:
            case "value":
                wire.send(*_value(instances, wire, *content))
            case "retain":
                instances.retain(set(content[0]))
            case "reset":
                instances.reset()


def _value(
    instances: Instances, wire: PluginConnection, subject: str, element: str | None, clients: list[str], now: int
) -> tuple[str, Any]:
    try:
        return "result", instances.value(PluginSubject(subject, element), tuple(clients), RemoteQueries(wire, now))
    except ClosedError:
        raise
    except Exception as error:  # noqa: BLE001  a plugin may raise any exception
        return "failed", failure_text(error)


def _exit_with_the_detector() -> None:
    """Exit when the detector ends, whatever the plugin is doing: no process is left behind."""
    parent = os.getppid()
    while os.getppid() == parent:
        time.sleep(1)
    os._exit(0)


def main() -> None:
    """Run until the detector closes the connection; the detector stops this process, not the terminal's Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_the_detector, daemon=True).start()
    with contextlib.suppress(ClosedError):
        _serve(PluginConnection(socket.socket(fileno=int(sys.argv[1]))))


if __name__ == "__main__":
    main()
