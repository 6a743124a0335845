"""The state volume: open episodes in one file, so that those without tasks survive a restart, even a kill -9.

A separate thread replaces the file atomically, so the evaluation never waits for the disk and no reader sees half a
file. Only the latest set of episodes is queued: a slow disk writes less often, and a kill loses what happened since the
last write. An episode that ended in that time is open again after the restart, and ends again with the same id.

A detector restores the open episodes of its own live tasks first, then those of its state volume.
"""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Sequence
from contextlib import aclosing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from detector.actions.deploy.stores import Snapshot, TaskStore, live_demands
from detector.engine.episodes.demands import Demand
from detector.engine.episodes.record import OpenEpisode, from_document
from wayside.api import Detector
from wayside.names import encode
from wayside.process.backoff import Backoff, retry
from wayside.process.files import replace_file, sync_folder

_log = logging.getLogger(__name__)

_VERSION = 1
_RETRY = 5.0
"""Maximum seconds after which a failed write is retried, if nothing changes before."""


def state_file(detector: Detector, holder: str) -> StateFile | None:
    """The Detector's state volume, if it has one. Raises OSError if it cannot be written."""
    state = detector.spec.state
    if state is None:
        return None
    try:
        return StateFile(Path(state.path), detector.namespace, holder)
    except OSError as error:
        raise OSError(
            f"spec.state.path: cannot write {state.path} ({error.strerror}): give a folder that the "
            "detector may write to"
        ) from error


class StateFile:
    """The open episodes of one holder, in a folder. `save` is for one thread at a time."""

    def __init__(self, folder: Path, namespace: str, holder: str) -> None:
        """Create the folder if it is missing. Raises OSError if it cannot be written."""
        folder.mkdir(parents=True, exist_ok=True)
        self._whose = {"namespace": namespace, "holder": holder}
        self.path = folder / f"{encode(namespace)}_{encode(holder)}.json"
        self._draft = self.path.with_suffix(".new")
        self._draft.touch()
        self._changed = threading.Condition()
        self._wanted: Sequence[OpenEpisode] | None = None
        self._closing = False
        self._backoff = Backoff(_RETRY, _RETRY)
        self._thread: threading.Thread | None = None
        self.failures = 0
        """Number of failed writes; each was retried."""
        self.last_failure = ""
        self.set_aside = 0
        """Files that could not be read."""

    def load(self) -> list[OpenEpisode]:
        """The episodes that were open when the file was last written; none if there is no file.

        An unreadable file is logged and renamed to an unused name; nothing is restored then.
        """
        try:
            text = self.path.read_bytes()
        except FileNotFoundError:
            return []
        except OSError as error:
            _log.error("cannot read %s; restoring no episodes: %s", self.path, error)
            return []
        try:
            return self._read(text)
        except (ValueError, RecursionError) as error:
            self._set_aside(error)
            return []

    def _read(self, text: bytes) -> list[OpenEpisode]:
        document: Any = json.loads(text)
        if not isinstance(document, dict) or document.get("version") != _VERSION:
            raise ValueError(f"its version is not {_VERSION}")
        if document.get("of") != self._whose:
            raise ValueError(f"it belongs to {document.get('of')}, not to {self._whose}")
        episodes = document.get("episodes")
        if not isinstance(episodes, list) or not all(isinstance(each, dict) for each in episodes):
            raise ValueError("its episodes are not a list of maps")
        return [from_document(each) for each in episodes]

    def _set_aside(self, error: Exception) -> None:
        number = 1
        while (aside := self.path.with_suffix(f".unreadable-{number}")).exists():
            number += 1
        self.set_aside += 1
        try:
            self.path.rename(aside)
        except OSError as refused:
            _log.error("cannot read %s: %s; cannot rename the file either: %s", self.path, error, refused)
        else:
            _log.error("cannot read the state; renamed the file to %s and restored no episodes: %s", aside, error)

    def save(self, episodes: Sequence[OpenEpisode]) -> None:
        """Save the open episodes. Never waits; only the latest set counts."""
        with self._changed:
            self._wanted = episodes
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="state", daemon=True)
                self._thread.start()
            self._changed.notify()

    def close(self) -> None:
        """Write the queued set; returns when that has succeeded or failed."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join()
        self._draft.unlink(missing_ok=True)

    def _run(self) -> None:
        closing = False
        while not closing:
            with self._changed:
                self._changed.wait_for(lambda: self._wanted is not None or self._closing)
            closing = retry(self._attempt, OSError, self._failed, self._pause)

    def _attempt(self) -> bool:
        """Write the newest set, if there is one; returns whether it was the last attempt."""
        with self._changed:
            wanted, self._wanted = self._wanted, None
            closing = self._closing
        try:
            if wanted is not None:
                self._write(wanted)
        except OSError as error:
            with self._changed:
                if self._wanted is None:
                    self._wanted = wanted
            if not closing:
                raise
            self._failed(error)
        else:
            self._backoff.succeed()
        return closing

    def _failed(self, error: OSError) -> float:
        self.failures += 1
        self.last_failure = str(error)
        if not self._backoff.failures:
            _log.error("cannot write the state; retrying: %s", error)
        return self._backoff.fail()

    def _pause(self, seconds: float) -> None:
        """Wait for at most this time: a newer set, or `close`, ends the wait."""
        with self._changed:
            if not self._closing:
                self._changed.wait(seconds)

    def _write(self, episodes: Sequence[OpenEpisode]) -> None:
        document = {
            "version": _VERSION,
            "of": self._whose,
            "episodes": [episode.to_document() for episode in episodes],
        }
        # Not json.dump: each call leaves some thirty objects in cycles, which are rarely collected here.
        text = json.dumps(document, separators=(",", ":"), allow_nan=False)
        replace_file(self.path, text, draft=self._draft, durable=True)
        sync_folder(self.path.parent)


@dataclass(frozen=True, slots=True)
class RestoredState:
    """The input of `Engine.restore`."""

    demands: Sequence[Demand] = ()
    """Of live tasks, oldest first."""
    episodes: Sequence[OpenEpisode] = ()
    """Of the state volume, except those whose task has ended: the detector ended it and was killed before it wrote."""


async def what_was_open(store: TaskStore, state: StateFile | None) -> RestoredState:
    """Read both. Waits while the store is unavailable; cancel it to give up."""
    async with aclosing(store.follow()) as changes:
        async for change in changes:
            if isinstance(change, Snapshot):
                episodes = [] if state is None else state.load()
                over = _ended(change)
                return RestoredState(live_demands(change), [each for each in episodes if each.record.id not in over])
    raise AssertionError("the stream of a store's changes ended")


def _ended(snapshot: Snapshot) -> set[str]:
    """The ids of the episodes whose tasks have ended."""
    specs = (stored.task.spec for stored in snapshot.tasks.values() if not stored.live)
    return {spec.event.id for spec in specs if spec.event is not None}
