"""Runs each plugin signal in a separate process, so that a plugin that hangs or crashes is stopped and the rules
continue.

The value is computed at the tick: the engine's thread waits for it, and answers the plugin's queries in the meantime.
Only the set of calls that find no running plugin depends on the speed of the machine. `outages` records it and replays
it, so that the replay of an intake file gives the same events.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence

from detector.engine.queries.queries import Queries
from detector.engine.scoping.plugins import PluginCall, PluginFailedError
from detector.plugins.outages import Outages
from detector.plugins.process import PATIENCE, START_PATIENCE, SignalProcess, StoppedError
from wayside.expressions import Reason, Value
from wayside.rules import CompiledRule

REPLAY_PATIENCE = 10.0
"""Seconds in a replay, which can wait."""


class ProcessHost:
    """See PluginHost."""

    def __init__(
        self,
        outages: Outages | None = None,
        *,
        wait: bool = False,
        patience: float = PATIENCE,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """`wait`: for a process that is starting, as in a replay; live, the signal is unknown until it has started.

        `patience` and the result of `monotonic` are in seconds.
        """
        self.outages = outages or Outages()
        self._wait = wait
        self._patience = patience
        self._monotonic = monotonic
        self._signals: dict[tuple[str, str], SignalProcess] = {}

    def configure(self, rules: Sequence[CompiledRule], kept: Collection[str]) -> None:
        """See PluginHost."""
        before, self._signals = self._signals, {}
        for rule in rules:
            for plugin in rule.plugins if rule.enabled else ():
                place = rule.name, plugin.name
                if place in before and rule.name in kept:
                    self._signals[place] = before.pop(place)
                else:
                    self._signals[place] = SignalProcess(rule.name, plugin, self._monotonic)
        for signal in before.values():
            signal.stop()
        for signal in self._signals.values():
            signal.start()

    def value(self, call: PluginCall, queries: Queries) -> Value:
        """See PluginHost."""
        signal = self._signals[call.rule, call.signal]
        if not self.outages.expects(call):
            signal.reset()
            raise PluginFailedError(Reason.ABSENT, "the plugin was not running when this was recorded")
        if not signal.is_ready(START_PATIENCE if self._wait else 0.0, again=not self._wait):
            self.outages.note(call, running=False)
            raise PluginFailedError(Reason.ABSENT, signal.why)
        try:
            value = signal.request_value(call, queries, self._patience)
        except StoppedError as error:
            self.outages.note(call, running=False)
            raise PluginFailedError(Reason.ERROR, str(error)) from None
        except PluginFailedError:
            self.outages.note(call, running=True)
            raise
        self.outages.note(call, running=True)
        return value

    def keep(self, rule: str, subjects: Collection[str]) -> None:
        """See PluginHost."""
        for (of_rule, _), signal in self._signals.items():
            if of_rule == rule:
                signal.keep(subjects)

    def reset(self) -> None:
        """See PluginHost."""
        for signal in self._signals.values():
            signal.reset()

    def close(self) -> None:
        """Stop all processes."""
        for signal in self._signals.values():
            signal.stop()
        self._signals.clear()
