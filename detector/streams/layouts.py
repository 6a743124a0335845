"""How a stream is subscribed to and its samples are delivered, by the layout of its keys.

Each layout has a separate pump, so that its work per sample costs the others nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import compress
from operator import itemgetter

import zenoh

from detector.streams import rmw_zenoh
from detector.streams.bursts import Put
from detector.streams.tally import Tally
from wayside.api.stream import Layout, Stream
from wayside.keys import KeyPattern

_PAYLOAD = itemgetter(1)


def pump_by_key(bursts: Iterable[Sequence[zenoh.Sample]], put: Put) -> None:
    """Delivers every message by its key, burst by burst; raises the errors of receiving a burst."""
    put_kind = zenoh.SampleKind.PUT
    for burst in bursts:
        messages = [(str(sample.key_expr), sample.payload.to_bytes()) for sample in burst]
        if not all(map(_PAYLOAD, messages)):  # a deletion is no message; checking the kind of each would cost more
            messages = list(compress(messages, [sample.kind == put_kind for sample in burst]))
        put(messages)


Pump = Callable[[Iterable[Sequence[zenoh.Sample]]], None]
"""Delivers all samples, burst by burst; raises the errors of receiving a burst."""


def expression(stream: Stream) -> zenoh.KeyExpr:
    """The key expression to subscribe to. Raises KeyPatternError."""
    topics = KeyPattern.parse(stream.key).expression
    match stream.layout:
        case Layout.PLAIN:
            return zenoh.KeyExpr.autocanonize(topics)
        case Layout.RMW_ZENOH:
            return zenoh.KeyExpr.autocanonize(rmw_zenoh.topics_expression(topics, stream.domain))


def pump_for(stream: Stream, put: Put, tally: Tally) -> Pump:
    """The function that delivers the stream's samples; problems on the way are counted in the tally."""
    match stream.layout:
        case Layout.PLAIN:
            return partial(pump_by_key, put=put)
        case Layout.RMW_ZENOH:
            return partial(
                rmw_zenoh.pump_by_topic, put=put, reader=rmw_zenoh.RmwReader(stream.name, stream.type, tally)
            )
