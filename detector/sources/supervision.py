"""Runs sources: each on a separate thread, restarted when it fails, and abandoned if it does not stop."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import Any

from detector.sources.base import Feed, Putter
from detector.sources.registry import Make, prepare_source
from detector.streams.loss_counter import Cause, LossCounter
from wayside.api import Detector
from wayside.api.plugin import DataSource
from wayside.api.stream import Stream
from wayside.process.backoff import Backoff, retry

log = logging.getLogger(__name__)

_FIRST_PAUSE = 0.5
_LONGEST_PAUSE = 30.0
"""Maximum seconds before a failed source restarts: the pause doubles from the first to the longest."""

_STEADY = 60.0
"""Seconds: a run of at least this duration resets the backoff."""

_TIMEOUT = 2.0
"""Seconds for which sources may take to stop."""


class SourceState(StrEnum):
    """The state of a source."""

    RUNNING = "Running"
    PAUSING = "Pausing"
    """It failed, and will be restarted after a pause."""
    FINISHED = "Finished"
    """It has no more messages."""
    STOPPED = "Stopped"


class SourceThread:
    """One running source."""

    def __init__(
        self,
        source: DataSource,
        streams: tuple[Stream, ...],
        putter: Putter,
        loss_counter: LossCounter,
        *,
        first_pause: float = _FIRST_PAUSE,
        longest_pause: float = _LONGEST_PAUSE,
    ) -> None:
        """The pauses are in seconds. Raises PluginError, KeyPatternError."""
        self.source = source
        self.streams = streams
        self.state = SourceState.RUNNING
        self.last_error = ""
        self._make: Make = prepare_source(source)
        self._loss_counter = loss_counter
        self._backoff = Backoff(first_pause, longest_pause)
        self._feed = Feed(streams, putter, lambda key: loss_counter.add(Cause.UNROUTED, source.name, last=key))
        self._thread = threading.Thread(target=self._run, name=f"source {source.name}", daemon=True)

    @property
    def messages(self) -> int:
        """Number of delivered messages."""
        return self._feed.messages

    def start(self) -> None:
        """Begin; returns at once."""
        self._thread.start()

    def request_stop(self) -> None:
        """Ignore its further messages; returns at once."""
        self._feed.stop()

    def join(self, timeout: float) -> None:
        """Wait for its end, for at most `timeout` seconds; then it is abandoned, logged and counted."""
        self._thread.join(timeout)
        if self._thread.is_alive():
            self._loss_counter.add(Cause.LEFT_BEHIND, self.source.name)
            log.error(
                "source %s (%s) does not stop; abandoning its thread: its run() must check feed.stopping",
                self.source.name,
                self.source.plugin,
            )

    def _run(self) -> None:
        retry(self._attempt, BaseException, self._failed, self._feed.wait)
        if self._feed.stopping:
            self.state = SourceState.STOPPED
        else:
            self.state = SourceState.FINISHED
            log.info("source %s has ended after %d messages", self.source.name, self.messages)

    def _attempt(self) -> None:
        """Run it; raises anything, since this is third-party code."""
        if self._feed.stopping:
            return
        self.state = SourceState.RUNNING
        began = time.monotonic()
        try:
            self._make().run(self._feed)
        except BaseException:
            if time.monotonic() - began >= _STEADY:
                self._backoff.succeed()
            if not self._feed.stopping:
                raise

    def _failed(self, error: BaseException) -> float:
        pause = self._backoff.fail()
        self.state = SourceState.PAUSING
        self.last_error = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        self._loss_counter.add(Cause.FAILED, self.source.name, last=self.last_error)
        log.warning("source %s failed; restarting it in %.1f s: %s", self.source.name, pause, self.last_error)
        log.debug("source %s", self.source.name, exc_info=error)
        return pause


class Sources:
    """The sources of a Detector, which may change."""

    def __init__(self, putter: Putter, loss_counter: LossCounter) -> None:
        """`putter` returns the function that receives messages of streams."""
        self._putter = putter
        self._loss_counter = loss_counter
        self._threads: dict[str, SourceThread] = {}

    def follow(self, detector: Detector) -> None:
        """Run the Detector's sources; unchanged ones with unchanged streams keep running. May wait for ends.

        Raises:
            PluginError: a source cannot be loaded; then nothing has changed.
        """
        wanted = {
            source.name: (source, tuple(stream for stream in detector.spec.streams if stream.source == source.name))
            for source in detector.spec.sources
        }
        new = {
            name: SourceThread(source, streams, self._putter, self._loss_counter)
            for name, (source, streams) in wanted.items()
            if (running := self._threads.get(name)) is None
            or running.source != source
            or _delivered(running.streams) != _delivered(streams)
        }
        self._stop({name: thread for name, thread in self._threads.items() if name not in wanted or name in new})
        for name, thread in new.items():
            self._threads[name] = thread
            thread.start()

    @property
    def threads(self) -> list[SourceThread]:
        """The sources that are running, or ended by themselves; for any thread."""
        return list(self._threads.values())

    def close(self) -> None:
        """Stop all; returns when they have stopped, or after the timeout."""
        self._stop(dict(self._threads))

    def _stop(self, threads: Mapping[str, SourceThread]) -> None:
        for thread in threads.values():
            thread.request_stop()
        deadline = time.monotonic() + _TIMEOUT
        for name, thread in threads.items():
            thread.join(max(0.0, deadline - time.monotonic()))
            del self._threads[name]


def _delivered(streams: Iterable[Stream]) -> list[dict[str, Any]]:
    """The settings of streams that matter to a source; those of buffering do not."""
    return [stream.model_dump(exclude={"buffer", "stale_after", "stamp", "latched"}) for stream in streams]
