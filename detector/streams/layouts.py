"""How a stream is subscribed to and its samples are handed over, by the layout of its keys.

A layout has a pump of its own, so that the work per sample of one costs the others nothing.
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
"""Hands over all samples, burst by burst; raises what taking the next burst raises."""


def expression(stream: Stream) -> zenoh.KeyExpr:
    """What to subscribe to. Raises KeyPatternError."""
    topics = KeyPattern.parse(stream.key).expression
    match stream.layout:
        case Layout.PLAIN:
            return zenoh.KeyExpr.autocanonize(topics)
        case Layout.RMW_ZENOH:
            return zenoh.KeyExpr.autocanonize(rmw_zenoh.topics_expression(topics, stream.domain))


def pump_for(stream: Stream, put: Put, tally: Tally) -> Pump:
    """What takes the stream's samples; what goes wrong on the way goes into the tally."""
    match stream.layout:
        case Layout.PLAIN:
            return partial(plain.pump, put=put)
        case Layout.RMW_ZENOH:
            return partial(rmw_zenoh.pump, put=put, reader=rmw_zenoh.RmwReader(stream.name, stream.type, tally))
