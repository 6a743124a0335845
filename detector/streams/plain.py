"""The plain key layout: the key is the topic, and only the payload of a sample matters."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import compress
from operator import itemgetter

import zenoh

from detector.streams.bursts import Put

_PAYLOAD = itemgetter(1)


def pump(bursts: Iterable[Sequence[zenoh.Sample]], put: Put) -> None:
    """Delivers every message, burst by burst; raises the errors of receiving a burst."""
    put_kind = zenoh.SampleKind.PUT
    for burst in bursts:
        messages = [(str(sample.key_expr), sample.payload.to_bytes()) for sample in burst]
        if not all(map(_PAYLOAD, messages)):  # a deletion is no message; checking the kind of each would cost more
            messages = list(compress(messages, [sample.kind == put_kind for sample in burst]))
        put(messages)
