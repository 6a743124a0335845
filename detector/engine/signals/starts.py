"""The episodes of rules in the form that other rules read: each start and end is a sample, and open episodes are known.

A start is stored for each of the episode's clients. An episode of the whole fleet has none: its start is stored once,
for all clients. Starts have a separate buffer with a separate cap. They are not data from a client, so they neither
keep it from timing out nor displace its samples.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final

from detector.engine.buffering.buffer import HOUSEKEEPING, NEVER, Buffer, Lane
from detector.engine.episodes.events import Event
from detector.engine.episodes.plain import plain, to_text
from detector.engine.episodes.subjects import FLEET
from detector.engine.samples.sample import Sample, StampedSample
from wayside.rules import CompiledRule, episode_stream

MAXIMUM_BYTES = 64 * 2**20
"""Maximum size of all starts; beyond it, the oldest are evicted and counted."""

ALWAYS: Final = 2**63 - 1
"""Later than all times: the end of an open episode."""


class EpisodeStarts:
    """The starts, ends and open episodes of the rules that signals of other rules name."""

    def __init__(self) -> None:
        self.buffer = Buffer(MAXIMUM_BYTES)
        self._durations: dict[str, int] = {}
        """For the rules that are named, by stream name of their starts: how long starts are kept, in nanoseconds."""
        self._evaluated: set[str] = set()
        self._open: dict[str, dict[str, dict[str, int]]] = {}
        """When open episodes started, by stream name of the starts, client and episode; nanoseconds."""
        self._ended: dict[str, dict[str, list[tuple[int, int]]]] = {}
        """Start and end of the episodes that ended since the last `expire`, by stream name of the starts and client."""
        self._number = 0
        self._expired = NEVER
        self.is_known: Callable[[str], bool] = lambda client: True
        """Whether the client is known: for a lost client no end is stored."""

    def configure(self, rules: Iterable[CompiledRule], least: int) -> set[str]:
        """Evaluate these rules from now on; starts are kept as long as any signal reaches back, or `least` (ns).

        Returns the rules that are newly named: report their open episodes with `started`.
        """
        durations: dict[str, int] = {}
        names: dict[str, str] = {}
        for rule in rules:
            for signal in rule.signals:
                if signal.rule is not None:
                    durations[signal.stream] = max(durations.get(signal.stream, least), signal.over_ns or 0)
                    names[signal.stream] = signal.rule
        new = {
            name for stream, name in names.items() if stream not in self._durations and stream == episode_stream(name)
        }
        self._durations = durations
        self._evaluated = {
            episode_stream(rule.name, ends=ends) for rule in rules if rule.enabled for ends in (False, True)
        }
        self.buffer.retain(durations)
        for lane in self.buffer:
            lane.duration = durations[lane.stream]
        self._open = {stream: each for stream, each in self._open.items() if stream in durations}
        self._ended.clear()
        return new

    def forget(self, rule: str) -> None:
        """The rule has changed its meaning or was removed: its past starts no longer count."""
        stream, ends = episode_stream(rule), episode_stream(rule, ends=True)
        self.buffer.retain([each for each in self._durations if each not in (stream, ends)])
        self._open.pop(stream, None)

    def note(self, event: Event) -> None:
        """An episode started or ended."""
        episode = event.episode
        if event.started:
            self.started(event, episode.start_time)
        elif event.end_time is not None:
            stream = episode_stream(episode.rule)
            open_episodes = self._open.get(stream, {})
            for client in episode.clients or (FLEET,):
                since = open_episodes.get(client, {}).pop(episode.id, None)
                if since is not None:
                    self._ended.setdefault(stream, {}).setdefault(client, []).append((since, event.end_time))
                if not open_episodes.get(client):
                    open_episodes.pop(client, None)
            clients = [client for client in episode.clients if self.is_known(client)] if episode.clients else [FLEET]
            self._put(episode_stream(episode.rule, ends=True), event.end_time, event, clients)

    def started(self, event: Event, since: int = NEVER) -> None:
        """An episode started, now or, if it was restored, earlier; `since`: when rules can first see it."""
        episode = event.episode
        stream = episode_stream(episode.rule)
        if stream not in self._durations:
            return
        clients = episode.clients or (FLEET,)
        for client in clients:
            self._open.setdefault(stream, {}).setdefault(client, {})[episode.id] = since
        self._put(stream, episode.start_time, event, clients)

    def _put(self, stream: str, time: int, event: Event, clients: Iterable[str]) -> None:
        """Store a start or an end for these clients, if any rule reads it."""
        if stream not in self._durations:
            return
        payload = _payload(event)
        for client in clients:
            lane = self.buffer.lane(client, stream)
            if lane is None:
                lane = self.buffer.add(Lane(client, stream, self._durations[stream]))
            self._number += 1
            sample = StampedSample(time, self._number, payload, event.key)
            self.buffer.grew(lane.insert(sample))

    def expire(self, now: int) -> None:
        """All ticks up to `now` (nanoseconds) were evaluated: drop starts and ends that later ticks do not read."""
        self._ended.clear()
        if not 0 <= now - self._expired < HOUSEKEEPING:
            self._expired = now
            self.buffer.expire(now)

    def step_back(self, time: int) -> None:
        """Time continues here, earlier than before. Open episodes stay open."""
        self.buffer.step_back(time)
        self._ended.clear()
        for of_clients in self._open.values():
            for episodes in of_clients.values():
                episodes.update(dict.fromkeys(episodes, NEVER))

    @property
    def needed(self) -> bool:
        """Whether any rule reads the episodes of another."""
        return bool(self._durations)

    def is_evaluated(self, stream: str) -> bool:
        """Whether the rule of these starts exists and is enabled; otherwise its episodes are unknown."""
        return stream in self._evaluated

    def is_open(self, client: str, stream: str, now: int) -> bool:
        """Whether an episode with the client among its subjects is open at this time; nanoseconds."""
        return any(begin <= now < end for begin, end in self.spans(client, stream))

    def spans(self, client: str, stream: str) -> list[tuple[int, int]]:
        """Start and end of episodes with the client among their subjects: open ones, and some that ended."""
        open_episodes, ended = self._open.get(stream, {}), self._ended.get(stream, {})
        found = [(since, ALWAYS) for whose in (client, FLEET) for since in open_episodes.get(whose, {}).values()]
        return found + [span for whose in (client, FLEET) for span in ended.get(whose, ())]

    def lane(self, client: str, stream: str) -> Lane | None:
        """The starts of the episodes with the client among their subjects."""
        return self.buffer.lane(client, stream) or self.buffer.lane(FLEET, stream)

    def forget_clients(self, clients: Iterable[str]) -> None:
        """Forget lost clients; if they return, past starts do not count. (Open episodes end by an event.)"""
        for client in clients:
            self.buffer.forget(client)

    def values(
        self, stream: str, sample: Sample, names: frozenset[str], parameters: Mapping[str, Any]
    ) -> dict[str, Any]:
        """The variables of an expression over one start."""
        values: dict[str, Any] = {"key": {}, "parameters": parameters}
        if "msg" in names:
            values["msg"] = json.loads(sample.payload, parse_int=float)
        seconds = sample.received / 10**9
        values["sample"] = {"received": seconds, "stamp": seconds, "latency": 0.0, "size": float(len(sample.payload))}
        return values


def _payload(event: Event) -> bytes:
    episode = event.episode
    message: Mapping[str, Any] = {
        "episode": episode.id,
        "subject": episode.subject,
        "subjects": list(episode.clients),
        **({} if episode.element is None else {"element": episode.element}),
        "onsetTime": episode.onset_time / 10**9,
        "startTime": episode.start_time / 10**9,
        **({} if event.end_time is None else {"endTime": event.end_time / 10**9, "reason": event.reason}),
        "values": plain(event.values),
    }
    return to_text(message).encode()
