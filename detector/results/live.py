"""The live view: what a detector currently evaluates, over Foxglove's WebSocket protocol.

    evaluation ─▶ a tracer for each second ─▶ queue ─▶ thread: messages ─▶ server ─▶ clients

The evaluation only passes on tracers. Rules are observed if somebody has subscribed to one of their channels; from time
to time all are, to open channels for new subjects.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import foxglove
import msgspec
from foxglove.channels import LogChannel, SceneUpdateChannel
from foxglove.websocket import ChannelView, Client, ServerListener

from detector.engine.columns.block import Block, Track
from detector.engine.columns.fleets import FleetBlock
from detector.engine.columns.pairs import PairBlock
from detector.engine.columns.table import Truths
from detector.engine.columns.verdicts import Codes
from detector.engine.engine import Engine
from detector.engine.episodes.events import Event
from detector.engine.scoping.scopes import Evaluated
from detector.findings.losses import Loss
from detector.results.channels import (
    EPISODE,
    EPISODES,
    LOG,
    SCENE,
    episode_message,
    log_message,
    subject_channel,
    topic_of,
)
from detector.results.result import Result
from detector.results.scene import Scene
from detector.results.thresholds import terms_of
from detector.results.tracing import Tracer
from wayside.inputerror import InputError
from wayside.rules import CompiledRule

_log = logging.getLogger(__name__)

_SLICE = 1_000_000_000
"""Nanoseconds of evaluation that are passed on at a time."""
_SURVEY = 5_000_000_000
"""Nanoseconds between two scans for new subjects."""
_WAITING = 8
"""Maximum number of slices that are queued for the view's thread."""
_NEW = 200
"""Maximum number of channels that are opened with one slice."""
_MOST = 1000
"""Maximum number of channels of subjects."""
_BACKLOG = 16384
"""Maximum number of messages that are queued for a client; beyond it, the oldest is dropped."""
_ALL = 1 << 20
"""Disables thinning."""


class ViewError(InputError, OSError):
    """The view cannot be served."""


class _Slice(NamedTuple):
    """The evaluation of one second."""

    tracer: Tracer
    rules: Mapping[str, CompiledRule]
    events: Sequence[Event]


class _Open(NamedTuple):
    """The channel of a subject."""

    rule: str
    digest: str
    schema: dict[str, Any]
    channel: foxglove.Channel


class LiveView:
    """Serves the channels. `attend`, `cycle_finished` and the observer's methods run on the evaluation's thread."""

    def __init__(self, host: str, port: int) -> None:
        """Raises ViewError if the address is in use."""
        self._context = foxglove.Context()
        self._subscriptions = _Subscriptions()
        try:
            self._server = foxglove.start_server(
                name="Wayside",
                host=host,
                port=port,
                context=self._context,
                server_listener=self._subscriptions,
                message_backlog_size=_BACKLOG,
            )
        except Exception as error:
            raise ViewError(f"--foxglove: {host}:{port} cannot be served ({error}): give another port") from error
        self._tracer: Tracer | None = None
        self._since = 0
        """When the tracer began."""
        self._surveyed = 0
        """When new subjects were last scanned for."""
        self._events: list[Event] = []
        self._dropped = 0
        self._slices: queue.Queue[_Slice | None] = queue.Queue(_WAITING)
        self._channels: dict[str, _Open] = {}
        self._digests: dict[str, str] = {}
        self._full = False
        self._scene = Scene()
        self._episodes = foxglove.Channel(EPISODES, schema=EPISODE, message_encoding="json", context=self._context)
        self._log_lines = LogChannel(LOG, context=self._context)
        self._scenes = SceneUpdateChannel(SCENE, context=self._context)
        self._thread = threading.Thread(target=self._serve, name="live view", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The port on which it is served."""
        return self._server.port

    def close(self) -> None:
        """Stop; clients are disconnected."""
        self._slices.put(None)
        self._thread.join()
        self._server.stop()

    def losses(self) -> Iterator[Loss]:
        """The items that were not shown."""
        what = "seconds omitted from the live view because its thread is too slow"
        yield Loss(what, self._dropped, cause="view_dropped")

    # The evaluation

    def attend(self, engine: Engine) -> None:
        """The engine uses other rules from now on."""
        for name, run in engine.rules.items():
            if name not in engine.in_columns:
                run.on_evaluated = self._recorder_of(run.rule)

    def cycle_finished(self, engine: Engine, events: Sequence[Event]) -> None:
        """The engine has taken in the arrivals, and these events occurred."""
        self._events += events
        if self._tracer is None:
            self._tracer = self._next(engine.now)
        elif engine.now - self._since >= _SLICE:
            self._hand_over(self._tracer, engine)
            self._tracer = self._next(engine.now)

    def _next(self, now: int) -> Tracer | None:
        """The next tracer; None if there is no subscription, and no scan for new subjects is due."""
        topics = self._subscriptions.topics
        self._since = now
        if now - self._surveyed >= _SURVEY:
            self._surveyed = now
            return Tracer()
        if not topics:
            return None
        subjects: dict[str, set[str]] = {}
        for topic in topics - {EPISODES, LOG, SCENE}:
            _, _, rule, subject = topic.split("/", 3)
            subjects.setdefault(rule, set()).add(subject)
        return Tracer(subjects, paths=SCENE in topics)

    def _hand_over(self, tracer: Tracer, engine: Engine) -> None:
        tracer.flush()
        rules = {name: run.rule for name, run in engine.rules.items()}
        try:
            self._slices.put_nowait(_Slice(tracer, rules, self._events))
        except queue.Full:
            self._dropped += 1  # its events come with the next
        else:
            self._events = []

    def _recorder_of(self, rule: CompiledRule) -> Any:
        def record(evaluated: Evaluated) -> None:
            if self._tracer is not None and self._tracer.traces(rule.name):
                self._tracer.recorded(rule).record(evaluated)

        return record

    def clients(self, tracks: Sequence[Track], block: Block, codes: Codes, selected: Truths | None) -> None:
        """See `Observer`."""
        if self._tracer is not None:
            self._tracer.clients(tracks, block, codes, selected)

    def fleet(self, tracks: Sequence[Track], block: FleetBlock) -> None:
        """See `Observer`."""
        if self._tracer is not None:
            self._tracer.fleet(tracks, block)

    def pairs(self, track: Track, these: PairBlock) -> None:
        """See `Observer`."""
        if self._tracer is not None:
            self._tracer.pairs(track, these)

    # The view's thread

    def _serve(self) -> None:
        while (each := self._slices.get()) is not None:
            try:
                self._show(each)
            except Exception:  # noqa: BLE001  an error here must only affect the view
                _log.exception("cannot write one second of data to the live view")
                self._dropped += 1

    def _show(self, shown: _Slice) -> None:
        topics = self._subscriptions.topics
        self._forget(shown.rules)
        result = self._result(shown, topics)
        for subject in result.trace.subjects:
            schema, messages = subject_channel(result, subject, _ALL)
            topic = topic_of(subject.rule, subject.subject)
            channel = self._channel(topic, result.rules[subject.rule], schema)
            if topic in topics:
                for time, payload in messages:
                    channel.log(payload, log_time=time)
        for event in shown.events:
            time = event.time
            if EPISODES in topics:
                self._episodes.log(msgspec.json.encode(episode_message(event)), log_time=time)
            if LOG in topics:
                self._log_lines.log(log_message(event, time), log_time=time)
        if SCENE in topics:
            for time, update in self._scene.updates(result):
                self._scenes.log(update, log_time=time)
        else:
            self._scene.skip(result)

    def _result(self, shown: _Slice, topics: frozenset[str]) -> Result:
        """The slice, with the subjects of subscribed channels, and some without a channel."""
        new: set[str] = set()

        def wanted(rule: str, subject: str) -> bool:
            topic = topic_of(rule, subject)
            if topic in self._channels:
                return topic in topics
            if topic not in new and len(new) < min(_NEW, _MOST - len(self._channels)):
                new.add(topic)
            return topic in new

        trace = shown.tracer.trace(wanted)
        trace.subjects = [each for each in trace.subjects if each.rule in shown.rules]
        if len(self._channels) >= _MOST and not self._full:
            self._full = True
            _log.warning("the live view has the maximum of %d channels: not showing further subjects", _MOST)
        rules = shown.rules
        terms = {(each.rule, each.subject): terms_of(rules[each.rule], each) for each in trace.subjects}
        return Result("live", trace, shown.events, (), rules, {}, terms, (), {}, (), 0)

    def _channel(self, topic: str, rule: CompiledRule, schema: dict[str, Any]) -> foxglove.Channel:
        """The subject's channel; it is reopened if its schema has grown."""
        known = self._channels.get(topic)
        if known is not None:
            if schema == known.schema:
                return known.channel
            schema = {**schema, "properties": _merged(known.schema["properties"], schema["properties"])}
            if schema == known.schema:
                return known.channel
            known.channel.close()
        channel = foxglove.Channel(topic, schema=schema, message_encoding="json", context=self._context)
        self._channels[topic] = _Open(rule.name, rule.digest, schema, channel)
        return channel

    def _forget(self, rules: Mapping[str, CompiledRule]) -> None:
        """Close the channels of removed or changed rules."""
        digests = {name: rule.digest for name, rule in rules.items()}
        if digests == self._digests:
            return
        self._digests = digests
        for topic, known in [*self._channels.items()]:
            if digests.get(known.rule) != known.digest:
                known.channel.close()
                del self._channels[topic]


class _Subscriptions(ServerListener):
    """Tracks the topics that clients have subscribed to. Called on the server's threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self.topics: frozenset[str] = frozenset()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """See `ServerListener`."""
        self._count(channel.topic, 1)

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        """See `ServerListener`."""
        self._count(channel.topic, -1)

    def _count(self, topic: str, change: int) -> None:
        with self._lock:
            self._counts[topic] += change
            self.topics = frozenset(name for name, count in self._counts.items() if count > 0)


def _merged(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """The merged properties of two schemas of one channel: a value that was unknown is declared as a number."""
    found = dict(new)
    for name, kind in old.items():
        other = found.get(name)
        if other is None or other == {"type": "number"}:
            found[name] = kind
        elif "properties" in kind and "properties" in other:
            found[name] = {**kind, "properties": _merged(kind["properties"], other["properties"])}
    return found
