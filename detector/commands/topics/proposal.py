"""Proposes streams for a recording: which keys belong together, and which part of them is the client."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from detector.commands.topics.survey import Topic, encoding_of, topic_shape
from wayside.api.stream import Encoding, Layout

_STALE_S = 5.0
"""The default of staleAfter."""
_MISSED = 3
"""Number of consecutive missing samples after which a stream is stale."""
_ALONE = "vehicle"
"""The client of keys that name none."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """A proposed stream, and its topics."""

    name: str
    key: str
    client: str | None
    """None: the key captures it."""
    encoding: Encoding
    type: str | None
    topics: Sequence[Topic]
    clients: Sequence[str]

    @property
    def count(self) -> int:
        """Number of messages."""
        return sum(topic.count for topic in self.topics)

    @property
    def rate(self) -> float | None:
        """Messages per second of one client, the median."""
        rates = sorted(topic.rate for topic in self.topics if topic.rate is not None)
        return rates[len(rates) // 2] if rates else None

    @property
    def worst(self) -> Topic:
        """The topic with the longest gap."""
        return max(self.topics, key=lambda topic: topic.gap)

    def document(self) -> dict[str, Any]:
        """The entry in `spec.streams`."""
        found: dict[str, Any] = {"name": self.name, "key": self.key}
        if self.client is not None:
            found["client"] = self.client
        found["encoding"] = self.encoding.value
        if self.encoding is Encoding.CDR and self.type is not None:
            found["type"] = self.type
        if self.topics[0].layout is not Layout.PLAIN:
            found["layout"] = self.topics[0].layout.value
        rate = self.rate
        if rate is not None and _MISSED / rate > _STALE_S:
            found["staleAfter"] = f"{math.ceil(_MISSED / rate)}s"
        elif rate is not None and rate >= _MISSED:
            found["staleAfter"] = "1s"
        return found


def proposals(topics: Sequence[Topic]) -> list[Proposal]:
    """A stream for each kind of data, in order of the keys. Keys that differ in only one chunk belong to several
    clients.

    Messages without a type are of one kind if they have the same fields. The client's chunk is the first in which such
    keys differ; other keys with the same text in that chunk belong to that client, too. If no key has a sibling,
    nothing distinguishes the client from the rest.
    """
    places = _places(topics)
    grouped: dict[tuple[str, int | None, Encoding, str | None], list[Topic]] = {}
    for topic in topics:
        chunks, place = topic.key.split("/"), places.get(topic.key)
        pattern = chunks if place is None else [*chunks[:place], "${client:*}", *chunks[place + 1 :]]
        grouped.setdefault(("/".join(pattern), place, encoding_of(topic), topic.type), []).append(topic)
    taken: set[str] = set()
    found = []
    for (key, place, encoding, kind), own in grouped.items():
        clients = [_ALONE] if place is None else [topic.key.split("/")[place] for topic in own]
        name = _name(key, taken)
        client = _ALONE if place is None else None
        found.append(Proposal(name, key, client, encoding, kind, own, list(dict.fromkeys(clients))))
    return found


def detector_document(
    found: Sequence[Proposal], messages: Sequence[Mapping[str, str]] = (), zenoh: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """A Detector with these streams; `messages`: definitions of types that only the recording has."""
    spec: dict[str, Any] = {"mode": "Standalone", "streams": [each.document() for each in found]}
    if zenoh is not None:
        spec = {"zenoh": zenoh, **spec}
    if messages:
        spec["messages"] = [*messages]
    return {"apiVersion": "wayside.dev/v1alpha1", "kind": "Detector", "metadata": {"name": "my-detector"}, "spec": spec}


def _places(topics: Sequence[Topic]) -> dict[str, int]:
    """By key, the index of the client's chunk."""
    siblings: dict[tuple[object, ...], set[str]] = {}
    for topic in topics:
        for place, group in _without_each(topic):
            siblings.setdefault(group, set()).add(topic.key.split("/")[place])
    clients: dict[int, set[str]] = {}
    found: dict[str, int] = {}
    for topic in topics:
        places = [place for place, group in _without_each(topic) if len(siblings[group]) > 1]
        if places:
            found[topic.key] = min(places)
            clients.setdefault(min(places), set()).add(topic.key.split("/")[min(places)])
    for topic in topics:
        chunks = topic.key.split("/")
        for place, names in clients.items():
            if place < min(len(chunks), found.get(topic.key, len(chunks))) and chunks[place] in names:
                found[topic.key] = place
    return found


def _without_each(topic: Topic) -> Iterator[tuple[int, tuple[object, ...]]]:
    """The index of each chunk, and the key without it."""
    chunks, kind = topic.key.split("/"), _kind(topic)
    for place in range(len(chunks)):
        if re.fullmatch(r"[A-Za-z0-9._:-]{1,63}", chunks[place]):
            yield place, (kind, place, *chunks[:place], None, *chunks[place + 1 :])


def _kind(topic: Topic) -> tuple[object, ...]:
    """The common properties of the topics of one stream; for messages without a type, the names of their fields."""
    shape = topic_shape(topic) if topic.type is None else None
    return topic.recorded_as, topic.type, None if shape is None else frozenset(shape.fields)


def _name(key: str, taken: set[str]) -> str:
    """A name for the stream, from the last chunks of its key."""
    chunks = [chunk for chunk in key.split("/") if not chunk.startswith("${")]
    parts: list[str] = []
    for chunk in reversed(chunks or ["stream"]):
        parts.insert(0, re.sub(r"[^a-z0-9]+", "-", chunk.lower()).strip("-") or "stream")
        name = "-".join(parts)[:63].strip("-")
        if name not in taken:
            break
    number = 2
    while name in taken:
        name, number = f"{'-'.join(parts)[:58]}-{number}", number + 1
    taken.add(name)
    return name
