"""Listens on a Zenoh network for a while, and surveys each key like those of a recording."""

from __future__ import annotations

import queue
import time

import zenoh

from detector.commands.topics.survey import Survey, Topic
from detector.streams.rmw_zenoh import MisfitError, split
from detector.streams.session import open_session
from wayside.api.stream import Encoding, Layout
from wayside.api.zenoh import Zenoh

_OURS = "wayside/"
"""Keys of detectors: events, follow-ups and responses."""
_ENCODINGS = {"application/json": Encoding.JSON, "application/cbor": Encoding.CBOR, "application/cdr": Encoding.CDR}


def listen(config: Zenoh, seconds: float) -> Survey:
    """The samples on all keys within `seconds`. Raises NetworkError if there is no session."""
    came: queue.SimpleQueue[tuple[int, zenoh.Sample]] = queue.SimpleQueue()
    topics: dict[str, Topic] = {}
    with open_session(config) as session:
        session.declare_subscriber("**", lambda sample: came.put((time.time_ns(), sample)))
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                at, sample = came.get(timeout=left)
            except queue.Empty:
                break
            key = str(sample.key_expr)
            if sample.kind != zenoh.SampleKind.PUT or key.startswith(_OURS):
                continue
            topic = topics.get(key)
            if topic is None:
                topic = topics[key] = _topic(key, str(sample.encoding).partition(";")[0])
            topic.add(at, sample.payload.to_bytes())
    return Survey(sorted(topics.values(), key=lambda topic: topic.key), [])


def _topic(key: str, encoding: str) -> Topic:
    try:
        name, kind = split(key)
    except MisfitError:
        recorded_as = _ENCODINGS.get(encoding)
        return Topic(key, "" if recorded_as is None else recorded_as.value, None, None)
    return Topic(name, Encoding.CDR.value, kind, None, layout=Layout.RMW_ZENOH)
