"""Publishes the configurations of instances on Zenoh: each on change, and as the reply to queries.

The key is `wayside/instances/<namespace>/<name>/configuration`, the value a JSON object of file names and texts. A
deletion of the key means that the instance was deleted.

Zenoh has its own threads and may be slow or unavailable, so the event loop never waits for it: it stores the newest
configuration of each instance here, and one thread publishes it. A newer configuration replaces one that is not
published yet, so there is at most one for each instance. After a lost connection, everything is published again,
because a change may have been missed meanwhile.
"""

from __future__ import annotations

import asyncio
import json
import logging
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import zenoh

from application_manager.core.objects.policy import Name
from wayside.kubernetes.connection import ConfigurationError
from wayside.process.backoff import Backoff, retry

_ALL = "wayside/instances/*/*/configuration"
_FIRST_PAUSE, _LONGEST_PAUSE = 0.2, 2.0  # s between attempts to reach the network
_REPEATS = (0.0, 1.0, 5.0)
"""Seconds after a new connection until everything is published.

Before the other side has announced its subscribers, a message reaches nobody.
"""
_CLOSING = 2.0  # s for the thread to end

log = logging.getLogger(__name__)


def key_of(name: Name) -> str:
    """The key of an instance's configuration."""
    return f"wayside/instances/{name[0]}/{name[1]}/configuration"


def settings(endpoints: Sequence[str]) -> zenoh.Config:
    """The Zenoh configuration: a client of the given endpoints, or the one given file.

    Raises ConfigurationError for anything else.
    """
    if len(endpoints) == 1 and Path(endpoints[0]).suffix in (".json5", ".json", ".yaml", ".yml"):
        try:
            return zenoh.Config.from_file(endpoints[0])
        except (zenoh.ZError, OSError) as error:
            raise ConfigurationError(f"--zenoh: cannot read the Zenoh configuration {endpoints[0]}: {error}") from None
    config = zenoh.Config()
    for path, value in (
        ("mode", "client"),
        ("connect/endpoints", list(endpoints)),
        ("connect/timeout_ms", 0),
        ("connect/exit_on_failure", True),  # we retry ourselves, and can be stopped meanwhile
        ("scouting/multicast/enabled", False),
    ):
        try:
            config.insert_json5(path, json.dumps(value))
        except zenoh.ZError:
            raise ConfigurationError(
                "--zenoh must be endpoints, e.g. tcp/zenoh:7447, or one Zenoh configuration file that ends with "
                f".json5; got {', '.join(endpoints)}"
            ) from None
    return config


class Publisher:
    """Accepts configurations immediately and publishes them in the background; without a network it discards them.

    `publish` and `withdraw` are for one thread, the event loop's.
    """

    def __init__(self, config: zenoh.Config | None) -> None:
        self._config = config
        self._lock = threading.Condition()
        self._contents: dict[str, bytes] = {}
        self._pending: dict[str, None] = {}  # keys whose content or deletion is not published yet, in order
        self._repeats: list[float] = []  # when to publish everything again, by the monotonic clock
        self._ended = False
        self._over = asyncio.Event()

    def publish(self, name: Name, files: Mapping[str, str]) -> None:
        """Publish the content of the files if it changed."""
        key, content = key_of(name), json.dumps(files, ensure_ascii=False, sort_keys=True).encode()
        with self._lock:
            if self._config is not None and self._contents.get(key) != content:
                self._contents[key] = content
                self._pending[key] = None
                self._lock.notify()

    def withdraw(self, name: Name) -> None:
        """Announce that an instance with a configuration was deleted, or has no configuration any longer."""
        key = key_of(name)
        with self._lock:
            if self._contents.pop(key, None) is not None:
                self._pending[key] = None
                self._lock.notify()

    def forget(self) -> None:
        """Forget all configurations without publishing: another manager has published since."""
        with self._lock:
            self._contents.clear()
            self._pending.clear()

    def finish(self) -> None:
        """Let `run` return."""
        self._over.set()

    async def run(self) -> None:
        """Publish until cancelled, or finished. Cancelled, it can be run again."""
        config = self._config
        if config is None:
            await self._over.wait()
            return
        with self._lock:
            self._ended = False
        loop, over = asyncio.get_running_loop(), self._over
        failure: list[BaseException] = []

        def work() -> None:
            try:
                self._work(config)
            except BaseException as error:  # noqa: BLE001  not lost: raised below, which ends the manager
                failure.append(error)
            finally:
                if not self._ended:
                    loop.call_soon_threadsafe(over.set)

        thread = threading.Thread(target=work, name="zenoh", daemon=True)
        thread.start()
        try:
            await over.wait()
        finally:
            with self._lock:
                self._ended = True
                self._lock.notify()
            await asyncio.to_thread(thread.join, _CLOSING)
        if failure:
            raise failure[0]

    def _work(self, config: zenoh.Config) -> None:
        session = self._opened(config)
        if session is None:
            return
        with session:
            listener = session.info.declare_transport_events_listener(self._transport, history=True)
            queryable = session.declare_queryable(_ALL, self._answer)  # both last as long as they are referenced
            while (pending := self._next()) is not None:
                for key, content in pending:
                    if content is None:
                        session.delete(key, congestion_control=zenoh.CongestionControl.BLOCK)
                    else:
                        session.put(
                            key,
                            content,
                            encoding=zenoh.Encoding.APPLICATION_JSON,
                            congestion_control=zenoh.CongestionControl.BLOCK,
                        )
            del queryable, listener

    def _opened(self, config: zenoh.Config) -> zenoh.Session | None:
        backoff = Backoff(_FIRST_PAUSE, _LONGEST_PAUSE)

        def failed(error: zenoh.ZError) -> float:
            if backoff.failures == 0:
                log.warning("zenoh: cannot connect; not publishing configurations; retrying: %s", error)
            return backoff.fail()

        def pause(seconds: float) -> None:
            with self._lock:
                self._lock.wait_for(lambda: self._ended, seconds)

        return retry(lambda: None if self._ended else zenoh.open(config), zenoh.ZError, failed, pause)

    def _next(self) -> list[tuple[str, bytes | None]] | None:
        """Wait for changes; None at the end."""
        with self._lock:
            while not self._ended and not self._pending:
                now = time.monotonic()
                if self._repeats and self._repeats[0] <= now:
                    self._repeats.pop(0)
                    self._pending |= dict.fromkeys(self._contents)
                else:
                    self._lock.wait(self._repeats[0] - now if self._repeats else None)
            if self._ended:
                return None
            changes = [(key, self._contents.get(key)) for key in self._pending]
            self._pending.clear()
            return changes

    def _transport(self, event: zenoh.TransportEvent) -> None:
        """Zenoh's thread calls it for every connection that opens or closes."""
        with self._lock:
            if event.kind == zenoh.SampleKind.PUT:
                now = time.monotonic()
                self._repeats = [now + each for each in _REPEATS]
                self._lock.notify()
                log.info("zenoh: connected; publishing %d configurations", len(self._contents))
            elif not self._ended:
                log.warning("zenoh: lost a connection; reconnecting")

    def _answer(self, query: zenoh.Query) -> None:
        """Zenoh's thread calls it for every query."""
        key_expr = query.key_expr
        with self._lock:
            exact = self._contents.get(str(key_expr))
            found = {str(key_expr): exact} if exact is not None else dict(self._contents)
        for key, content in found.items():
            if content is not None and key_expr.intersects(zenoh.KeyExpr(key)):
                query.reply(key, content, encoding=zenoh.Encoding.APPLICATION_JSON)
