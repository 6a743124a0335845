"""What an action stores on the state volume: undelivered events, rendered texts of open episodes, dead letters.

Without a state volume, or if its disk fails, everything else continues; events that would not survive a restart are
counted, and so are undelivered ones.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from detector.actions.base import Setting
from detector.actions.notify.dead_letters import DeadLetters
from detector.actions.notify.journal import Journal, JournalError
from detector.actions.notify.notice import Notice, NoticeTexts, notice_from, texts
from wayside.names import encode
from wayside.times import format_seconds

_log = logging.getLogger(__name__)

FOLDER = "notify"
"""In the folder of `spec.state`."""
_NOTICE, _OPEN = "notice/", "open/"
_LOST = "events not delivered to any target"
_UNKEPT = "events that would not survive a restart"


class Keeping:
    """Not thread-safe."""

    def __init__(self, setting: Setting) -> None:
        self._setting = setting
        self._journal: Journal | None = None
        self._letters: DeadLetters | None = None
        self._claimed: set[str] = set()
        """The keys of episodes that are open in this run: other stored ones have ended."""
        detector = setting.surroundings().detector
        state = detector.spec.state
        if state is None:
            return
        folder = Path(state.path) / FOLDER
        whose = (detector.namespace, setting.holder, setting.rule.name, setting.action)
        name = "_".join(map(encode, whose))
        self._letters = DeadLetters(folder / f"{name}.dead.jsonl")
        try:
            self._journal = Journal(folder, name)
        except JournalError as error:
            _log.error("the events of action %s of EventRule %s are not kept on disk: %s", *whose[:1:-1], error)
            setting.lose(_UNKEPT, 1, str(error))
            return
        if self._journal.unreadable:
            setting.lose(
                "lines of the journal that could not be read", self._journal.unreadable, "not JSON of this format"
            )

    def waiting(self) -> list[Notice]:
        """Undelivered events of earlier runs, oldest first."""
        found: list[Notice] = []
        for key, document in list(self._kept(_NOTICE).items()):
            try:
                found.append(notice_from(document))
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                self._setting.lose(_LOST, 1, f"cannot read the entry of the journal: {type(error).__name__}")
                self._drop([key])
        return found

    def keep(self, notice: Notice) -> None:
        """Store it until `delivered`."""
        self._put(_NOTICE + notice.id, notice.to_json())

    def delivered(self, notices: Iterable[Notice]) -> None:
        """Remove these."""
        self._drop([_NOTICE + notice.id for notice in notices])

    @property
    def keeps(self) -> bool:
        """Whether events queued at the end are sent after the next start."""
        return self._journal is not None

    def keeps_notice(self, notice: Notice) -> bool:
        """Whether this event is stored."""
        return self._journal is not None and _NOTICE + notice.id in self._journal.live

    def open(self, episode: str, rendered: NoticeTexts) -> None:
        """Store the rendered texts of an episode until its end: after a restart they cannot be rendered again."""
        key = _OPEN + episode
        self._claimed.add(key)
        self._put(key, rendered.to_json())

    def rendered(self, episode: str) -> NoticeTexts | None:
        """The stored texts of the episode."""
        document = None if self._journal is None else self._journal.live.get(_OPEN + episode)
        return None if document is None else texts(document)

    def over(self, episode: str) -> None:
        """The episode has ended: remove its texts."""
        self._claimed.discard(_OPEN + episode)
        self._drop([_OPEN + episode])

    def lose(self, notices: Iterable[Notice], why: str, attempts: int) -> None:
        """Give up these events: they become dead letters, and are counted."""
        lost = list(notices)
        self._setting.lose(_LOST, len(lost), why)
        for notice in lost:
            letter = {
                "created": format_seconds(notice.created),
                "rule": self._setting.rule.name,
                "action": self._setting.action,
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
                self._setting.lose("dead letters that could not be written", 1, str(error))
        self.delivered(lost)

    def close(self, keep: bool) -> None:
        """The last call. Without `keep` everything is removed."""
        self._drop([key for key in self._kept(_OPEN) if not keep or key not in self._claimed])
        if self._journal is not None:
            try:
                self._journal.close()
            except OSError as error:
                _log.error("cannot close the journal of action %s: %s", self._setting.action, error)

    def _kept(self, prefix: str) -> Mapping[str, dict[str, Any]]:
        live = {} if self._journal is None else self._journal.live
        return {key: document for key, document in live.items() if key.startswith(prefix)}

    def _put(self, key: str, document: Mapping[str, Any]) -> None:
        if self._journal is None:
            return
        try:
            self._journal.put(key, document)
        except OSError as error:
            self._setting.lose(_UNKEPT, 1, str(error))

    def _drop(self, keys: list[str]) -> None:
        if self._journal is None:
            return
        try:
            self._journal.drop(keys)
        except OSError as error:
            self._setting.lose("journal entries that could not be dropped", len(keys), str(error))
