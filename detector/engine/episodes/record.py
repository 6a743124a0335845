"""The data about an episode that are known from its start on. Events, demands and actions share the record."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from detector.engine.episodes.subjects import Subject
from wayside.api.base import JsonValue


class EpisodeRecord(msgspec.Struct, frozen=True, gc=False):
    """One occurrence of a rule's event, for one subject. Times are nanoseconds since the epoch."""

    id: str
    rule: str
    subject: str
    """The text in events: `car1`, `car1+car2`, `~fleet`, followed by `~` and the element of `each` if there is one."""
    clients: tuple[str, ...]
    """The clients of the subject."""
    element: str | None
    onset_time: int
    start_time: int
    values: Mapping[str, JsonValue]
    """The rule's variables at the start; unknown ones are left out."""
    classification: Mapping[str, JsonValue] | None
    rule_digest: str = ""
    """Digest of the rule's semantics under which it started."""

    @property
    def about(self) -> Subject:
        """The subject as clients and element."""
        return Subject(self.clients, self.element)
