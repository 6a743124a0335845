"""Events as lines of `events.jsonl`, written by a separate thread: a slow disk does not slow the evaluation."""

from __future__ import annotations

import logging
import queue
import threading
from pathlib import Path

_log = logging.getLogger(__name__)


class EventLog:
    """Appends one CloudEvent per line. At most `capacity` events are queued; further ones are dropped and counted."""

    def __init__(self, path: Path, *, capacity: int = 65536) -> None:
        """Creates the file's folder; existing contents of the file are kept.

        Raises:
            OSError: the file cannot be opened.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        self._file = path.open("a", encoding="utf-8")
        self._lines: queue.Queue[str | None] = queue.Queue(capacity)
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
            _log.error("%d events are missing in %s", self.dropped, self._path)

    def _run(self) -> None:
        while (line := self._lines.get()) is not None:
            try:
                self._file.write(line + "\n")
                if self._lines.empty():
                    self._file.flush()
            except (OSError, ValueError) as error:  # a disk that refuses, a text that is not valid UTF-8
                self.dropped += 1
                _log.error("cannot write an event to %s: %s", self._path, error)
