"""How a stream is subscribed to and its samples are delivered, by the layout of its keys.

Each layout has a separate pump, so that its work per sample costs the others nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial

import zenoh

from detector.streams import plain, rmw_zenoh
from detector.streams.bursts import Put
from detector.streams.tally import Tally
from wayside.api.stream import Layout, Stream
from wayside.keys import KeyPattern

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
            return partial(plain.pump, put=put)
        case Layout.RMW_ZENOH:
            return partial(
                rmw_zenoh.pump_by_topic, put=put, reader=rmw_zenoh.RmwReader(stream.name, stream.type, tally)
            )
