"""The data of an action on the state volume: undelivered events, rendered texts of open episodes, dead letters."""

from __future__ import annotations

import errno
import json
import logging
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from detector.actions.base import ActionContext
from detector.actions.journal import Journal
from detector.actions.notify.notice import Notice, NoticeTexts, notice_from, texts
from wayside.times import format_seconds

_log = logging.getLogger(__name__)

_NOTICE, _OPEN = "notice/", "open/"
_LOST = "events not delivered to any target"


class NotifyStore:
    """Not thread-safe."""

    def __init__(self, context: ActionContext) -> None:
        self._context = context
        self._journal = Journal(context, "notify", "events that would not survive a restart")
        path = self._journal.path
        self._letters = None if path is None else DeadLetters(path.with_name(f"{path.name}.dead.jsonl"))
        self._claimed: set[str] = set()
        """The keys of episodes that are open in this run: other stored ones have ended."""

    def waiting(self) -> list[Notice]:
        """Undelivered events of earlier runs, oldest first."""
        return list(self._journal.load_all(_NOTICE, notice_from).values())

    def store(self, notice: Notice) -> None:
        """Store the event until `delivered`."""
        self._journal.put(_NOTICE + notice.id, notice.to_json())

    def delivered(self, notices: Iterable[Notice]) -> None:
        """Remove these events: they were delivered."""
        self._journal.drop([_NOTICE + notice.id for notice in notices])

    def is_stored(self, notice: Notice) -> bool:
        """Whether this event is stored."""
        return self._journal.load(_NOTICE + notice.id, notice_from) is not None

    def open(self, episode: str, rendered: NoticeTexts) -> None:
        """Store the rendered texts of an episode until its end: after a restart they cannot be rendered again."""
        key = _OPEN + episode
        self._claimed.add(key)
        self._journal.put(key, rendered.to_json())

    def rendered(self, episode: str) -> NoticeTexts | None:
        """The stored texts of the episode."""
        return self._journal.load(_OPEN + episode, texts)

    def over(self, episode: str) -> None:
        """The episode has ended: remove its texts."""
        self._claimed.discard(_OPEN + episode)
        self._journal.drop([_OPEN + episode])

    def lose(self, notices: Iterable[Notice], why: str, attempts: int) -> None:
        """Give up these events: they become dead letters, and are counted."""
        lost = list(notices)
        self._context.lose(_LOST, len(lost), why)
        for notice in lost:
            letter = {
                "created": format_seconds(notice.created),
                "rule": self._context.rule.name,
                "action": self._context.action,
                "why": why,
                "attempts": attempts,
                "texts": notice.texts.to_json(),
                "event": notice.event,
            }
            try:
                if self._letters is None:
                    _log.error("event %s was not delivered to any target: %s", notice.id, why)
                else:
                    self._letters.write(letter)
            except (OSError, ValueError) as error:
                self._context.lose("dead letters that could not be written", 1, str(error))
        self.delivered(lost)

    def close(self, keep: bool) -> None:
        """The last call. Without `keep` everything is removed."""
        self._journal.drop(key for key in self._journal.keys(_OPEN) if not keep or key not in self._claimed)
        self._journal.close()


SIZE = 10 << 20
"""Maximum size of one file in bytes."""


class DeadLetters:
    """Undelivered events in a file: a JSON object per line, with the reason. Used by one thread at a time.

    A full file is renamed to `….old.jsonl`, replacing the previous one, and a new file begins.
    """

    def __init__(self, path: Path, size: int = SIZE) -> None:
        self.path, self._size = path, size

    def write(self, letter: Mapping[str, Any]) -> None:
        """Append a letter. Raises OSError if the disk refuses, ValueError if it is not valid JSON."""
        line = json.dumps(letter, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode() + b"\n"
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.exists() and self.path.stat().st_size + len(line) > self._size:
            os.replace(self.path, self.path.with_suffix(".old.jsonl"))
        with self.path.open("ab", buffering=0) as file:
            begun = file.tell()
            if file.write(line) != len(line):
                file.truncate(begun)  # remove a partial line
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
