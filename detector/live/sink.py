"""Where a running detector's events, demands and consequences go: Zenoh, a file, the task reconciler, actions."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from detector.actions.base import ActionError, DetectorConfiguration
from detector.actions.deploy.reconciler import DemandReconciler
from detector.actions.host import ActionHost
from detector.actions.tracing import EpisodeTraces
from detector.engine.consequences import Consequence
from detector.engine.episodes.demands import Demand
from detector.engine.episodes.events import Event
from detector.engine.episodes.record import OpenEpisode
from detector.live.requested import with_requested
from detector.live.state import StateFile
from detector.streams.zenoh import EVENT_ENCODING, Network, NetworkError
from wayside.api import EventRule

_log = logging.getLogger(__name__)

_CAPACITY = 65536
"""Maximum number of events that wait to be written to `events.jsonl`."""


class LiveSink:
    """Sends events to Zenoh and to the log, demands to the reconciler; nothing here waits."""

    def __init__(
        self,
        network: Network,
        holder: str,
        log: EventLog | None,
        reconciler: DemandReconciler,
        state: StateFile | None,
        traces: EpisodeTraces | None = None,
    ) -> None:
        self._traces = traces
        self._state = state
        self.network = network
        self.actions = ActionHost(holder, self)
        self._log = log
        self.reconciler = reconciler

    @property
    def unwritten(self) -> int:
        """Number of events missing from `events.jsonl`."""
        return 0 if self._log is None else self._log.dropped

    def events(self, events: Sequence[Event]) -> None:
        """Publish and log the starts and ends."""
        for event in events if self._traces is None else map(self._traces.event, events):
            line = event.to_json()
            self.network.publish(event.key, line.encode(), EVENT_ENCODING)
            if self._log is not None:
                self._log.write(line)
            _log.info(
                "%s %s %s%s",
                event.episode.rule,
                event.episode.subject,
                "started" if event.started else "ended",
                "" if event.reason is None else f" ({event.reason})",
            )
            if self._traces is not None:
                self._traces.over(event)

    def switch_network(self, network: Network) -> None:
        """Switch to the network of a changed Detector. A failure is logged."""
        dropped = self.network.dropped_events
        self.network.close()
        self.network = network
        self.network.dropped_events += dropped
        try:
            self.network.start()
        except NetworkError as error:
            _log.error("cannot open the Zenoh session of the changed Detector; correct spec.zenoh: %s", error)

    def open_episodes(self, episodes: Callable[[], Sequence[OpenEpisode]]) -> None:
        """Write the open episodes to the state volume, if there is one."""
        if self._state is not None:
            self._state.save(episodes())

    def follow(self, rules: Sequence[EventRule], configuration: DetectorConfiguration) -> None:
        """Run the actions of these rules."""
        self.actions.follow(with_requested(rules, configuration.detector), configuration)

    def consequences(self, consequences: Sequence[Consequence]) -> None:
        """Pass the consequences to the actions."""
        self.actions.dispatch(consequences if self._traces is None else self._traces.consequences(consequences))

    def publish(self, key: str, payload: bytes, encoding: str) -> None:
        """See `Messenger`: for the actions, which need not follow changes of the network."""
        self.network.publish(key, payload, encoding)

    def query(
        self, selector: str, payload: bytes | None, timeout: float, attachment: bytes | None = None
    ) -> list[bytes]:
        """See `Messenger`."""
        try:
            return self.network.query(selector, payload, timeout, attachment)
        except NetworkError as error:
            raise ActionError(str(error)) from error

    def demands(self, demands: Mapping[str, Demand], ended: Mapping[str, int]) -> None:
        """Pass the demands to the reconciler."""
        self.reconciler.update(demands, ended)


class EventLog:
    """Appends one CloudEvent a line of `events.jsonl`, on a separate thread: a slow disk does not slow the evaluation.

    A bounded number of events is queued; further ones are dropped and counted.
    """

    def __init__(self, path: Path) -> None:
        """Creates the file's folder; existing contents of the file are kept.

        Raises:
            OSError: the file cannot be opened.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        self._file = path.open("a", encoding="utf-8")
        self._lines: queue.Queue[str | None] = queue.Queue(_CAPACITY)
        self._thread = threading.Thread(target=self._run, name="event-log", daemon=True)
        self._thread.start()
        self.dropped = 0
        """Events dropped because the queue was full, or that could not be written."""

    def write(self, line: str) -> None:
        """Queue a line; never waits."""
        try:
            self._lines.put_nowait(line)
        except queue.Full:
            self.dropped += 1

    def close(self) -> None:
        """Write the queued lines, and close the file."""
        self._lines.put(None)
        self._thread.join()
        self._file.close()
        if self.dropped:
            _log.error("in total, %d events were not written to %s", self.dropped, self._path)

    def _run(self) -> None:
        while (line := self._lines.get()) is not None:
            try:
                self._file.write(line + "\n")
                if self._lines.empty():
                    self._file.flush()
            except (OSError, ValueError) as error:  # a disk that refuses, a text that is not valid UTF-8
                self.dropped += 1
                _log.error("cannot write an event to %s: %s", self._path, error)
