"""Runs each plugin signal in a separate process, so that a plugin that hangs or crashes is stopped and the rules
continue.

The value is computed at the tick: the engine's thread waits for it, and answers the plugin's queries in the meantime.
Only the set of calls that find no running plugin depends on the speed of the machine. `outages` records it and replays
it, so that the replay of an intake file gives the same events.

A process that does not return its value in time is killed, and its state is lost. It is restarted after growing pauses,
three times, and then stays stopped until the rule changes.
"""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from detector.engine.queries.queries import Queries
from detector.engine.scoping.plugins import PluginCall, PluginFailedError
from detector.plugins.outages import Outages
from detector.plugins.wire import ClosedError, PluginConnection
from wayside.expressions import Reason, Value
from wayside.rules import CompiledPlugin, CompiledRule

_log = logging.getLogger(__name__)

PATIENCE = 0.5
"""Seconds in which a live plugin must return its value: less than the stall after which ticks are skipped."""

START_PATIENCE = 60.0
"""Seconds in which a plugin must have started, if the caller waits for it."""

_PAUSES = (1.0, 10.0, 60.0)
"""Seconds before a stopped plugin is restarted; after the last one it stays stopped."""

_GLANCE = 0.0005
"""Seconds to check whether it has started."""

_QUERIES = frozenset({"clients", "streams", "newest", "last", "between", "nearest", "pose", "tuples", "transform"})


class StoppedError(Exception):
    """The process was stopped, or exited; the message gives the reason."""


class SignalProcess:
    """The process of one signal."""

    def __init__(self, rule: str, plugin: CompiledPlugin, monotonic: Callable[[], float]) -> None:
        self._rule = rule
        self._plugin = plugin
        self._monotonic = monotonic
        self._process: subprocess.Popen[bytes] | None = None
        self._wire: PluginConnection | None = None
        self._ready = False
        self._subjects: set[str] = set()
        self._starts = 0
        self._again_at = 0.0
        self.why = "its process is starting"

    def start(self) -> None:
        """Start the process, unless it has been started; returns at once."""
        if not self._starts:
            self._launch()

    def _launch(self) -> None:
        self._starts += 1
        self.why = "its process is starting"
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603  our own module
                [sys.executable, "-m", "detector.plugins.worker", str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=2,  # a plugin's output belongs to the log
                pass_fds=(theirs.fileno(),),
                env={**os.environ, "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))},
            )
        self._wire = PluginConnection(ours)
        self._wire.send("start", self._plugin.plugin, self._plugin.parameters)

    def is_ready(self, within: float, *, again: bool) -> bool:
        """Whether it is ready, after waiting `within` seconds for its start; `again`: restart a stopped one."""
        if self._process is None and again and self._starts <= len(_PAUSES) and self._monotonic() >= self._again_at:
            self._launch()
        if self._ready or self._wire is None:
            return self._ready
        try:
            answer, *content = self._wire.receive(max(within, _GLANCE))
        except TimeoutError:
            if within:
                self._end(f"did not start within {within:g} s")
            return False
        except ClosedError:
            self._end("exited while it was starting")
            return False
        if answer == "refused":
            self._end(f"cannot run: {content[0]}")
        self._ready = answer == "ready"
        return self._ready

    def request_value(self, call: PluginCall, queries: Queries, patience: float) -> Value:
        """The signal's value. Raises PluginFailedError if the plugin failed, StoppedError if its process stopped."""
        wire = self._wire
        assert wire is not None  # noqa: S101  it is ready
        self._subjects.add(call.subject)
        try:
            wire.send("value", call.subject, call.element, call.clients, queries.now, within=patience)
            while True:
                requested = self._monotonic()
                answer, *content = wire.receive(max(patience, 0.0))
                patience -= self._monotonic() - requested  # our time for the queries does not count as the plugin's
                match answer:
                    case "query":
                        _reply(wire, queries, *content)
                    case "failed":
                        raise PluginFailedError(Reason.ERROR, content[0])
                    case _:
                        value: Value = content[0]
                        return value
        except TimeoutError:
            raise StoppedError(self._end("did not return a value in time")) from None
        except ClosedError:
            raise StoppedError(self._end("exited")) from None

    def retain(self, subjects: Collection[str]) -> None:
        """Drop the state of all other subjects."""
        if not self._subjects <= set(subjects):
            self._subjects &= set(subjects)
            self._send("retain", sorted(self._subjects))

    def reset(self) -> None:
        """Drop all state."""
        if self._subjects:
            self._subjects.clear()
            self._send("reset")

    def stop(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        if self._wire is not None:
            self._wire.close()
        self._process = self._wire = None
        self._ready = False

    def _send(self, *message: Any) -> None:
        if self._ready and self._wire is not None:
            try:
                self._wire.send(*message, within=PATIENCE)
            except (TimeoutError, ClosedError):
                self._end("exited, or does not read its input")

    def _end(self, why: str) -> str:
        self.stop()
        self._subjects.clear()
        if self._starts <= len(_PAUSES):
            pause = _PAUSES[self._starts - 1]
            self._again_at = self._monotonic() + pause
            then = f"stopped, restarting in {pause:g} s"
        else:
            then = "stopped until the rule changes"
        self.why = f"its process {why}; {then}"
        _log.error(
            "EventRule %s, signal %s, plugin %s: %s", self._rule, self._plugin.name, self._plugin.plugin, self.why
        )
        return self.why


def _reply(
    wire: PluginConnection, queries: Queries, method: str, arguments: list[Any], options: Mapping[str, Any]
) -> None:
    try:
        if method not in _QUERIES:
            raise ValueError(f"there is no query {method}")
        answer: tuple[Any, ...] = "answer", getattr(queries, method)(*arguments, **options)
        wire.send(*answer, within=PATIENCE)
    except (ClosedError, TimeoutError):
        raise
    except Exception as error:  # noqa: BLE001  a plugin's queries must not stop the engine
        wire.send("raised", type(error).__name__, str(error))


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

    def retain(self, rule: str, subjects: Collection[str]) -> None:
        """See PluginHost."""
        for (of_rule, _), signal in self._signals.items():
            if of_rule == rule:
                signal.retain(subjects)

    def reset(self) -> None:
        """See PluginHost."""
        for signal in self._signals.values():
            signal.reset()

    def close(self) -> None:
        """Stop all processes."""
        for signal in self._signals.values():
            signal.stop()
        self._signals.clear()
