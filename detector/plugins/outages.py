"""Records the calls that found no running plugin: noted live, recorded with the intake, and replayed from it.

Calls of a signal are counted from the engine's start; this count is the same live and in a replay, independent of the
clock.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from detector.engine.scoping.plugins import PluginCall

KIND = "plugin"
"""The kind of these controls in an intake file."""


class Outages:
    """Notes when a plugin stops and runs again; in a replay, reads this from the recording."""

    def __init__(self, recorded: Callable[[], Iterable[Mapping[str, Any]]] | None = None) -> None:
        """`recorded` returns the controls of an intake file; it is called with the first call of a plugin."""
        self._recorded = recorded
        self._expected: dict[tuple[str, str], list[tuple[int, bool]]] | None = None
        self._calls: dict[tuple[str, str], int] = {}
        self._away: set[tuple[str, str]] = set()
        self._changes: list[dict[str, Any]] = []

    def expects(self, call: PluginCall) -> bool:
        """Whether the plugin ran at this call, according to the recording; call it once per call."""
        place = call.rule, call.signal
        number = self._calls[place] = self._calls.get(place, 0) + 1
        if self._expected is None:
            self._expected = {}
            for document in () if self._recorded is None else self._recorded():
                changes = self._expected.setdefault((document["rule"], document["signal"]), [])
                changes.append((document["call"], document["running"]))
        changes = self._expected.get(place, [])
        return next((running for since, running in reversed(changes) if since <= number), True)

    def note(self, call: PluginCall, *, running: bool) -> None:
        """Note whether the plugin ran at this call."""
        place = call.rule, call.signal
        if running is (place in self._away):
            (self._away.discard if running else self._away.add)(place)
            self._changes.append(
                {
                    "kind": KIND,
                    "rule": call.rule,
                    "signal": call.signal,
                    "call": self._calls[place],
                    "running": running,
                }
            )

    def take_changes(self) -> list[dict[str, Any]]:
        """The changes since the last call, as controls for the intake file."""
        taken, self._changes = self._changes, []
        return taken
