"""The variables that each kind of expression of a rule may use."""

from __future__ import annotations

from functools import cache, lru_cache

from wayside.api.eventrule import EventRuleSpec
from wayside.expressions import Environment, ExpressionError, Kind

RESERVED = frozenset({"client", "labels", "streams", "position", "a", "b", "distance"})
"""Names that the scopes give; no signal may take them."""

MEMBER_OF_CLIENT = ("client", "labels", "streams")

SAMPLE_MEMBERS = ("stamp", "received", "latency", "size")


@cache
def sample_environment() -> Environment:
    """For `value`, `where` and positions: one sample.

    msg is the decoded message, key the captured chunks, sample has stamp and received (seconds since the epoch),
    latency (seconds) and size (bytes).
    """
    return Environment({"msg": Kind.DYN, "key": Kind.MAP, "sample": Kind.MAP})


@cache
def stamp_environment() -> Environment:
    """For a stream's `stamp`: the decoded message alone."""
    return Environment({"msg": Kind.DYN})


@lru_cache(maxsize=1024)
def is_taken(name: str) -> bool:
    """Whether the name means something to CEL itself, so that no signal can have it."""
    try:
        Environment({name: Kind.DYN}).compile(name)
    except (ValueError, ExpressionError):
        return True
    return False


@lru_cache(maxsize=256)
def client_environment(signals: tuple[str, ...] = ()) -> Environment:
    """For a client scope: client, labels, streams (those that are not stale) and the signals."""
    fixed = {"client": Kind.STRING, "labels": Kind.MAP, "streams": Kind.LIST}
    return Environment({**fixed, **dict.fromkeys(signals, Kind.DYN)})


@cache
def pairs_environment() -> Environment:
    """For a pairs scope: a and b (maps of what a client scope has, and position), distance in metres."""
    return Environment({"a": Kind.MAP, "b": Kind.MAP, "distance": Kind.DOUBLE})


def condition_environment(spec: EventRuleSpec) -> Environment:
    """For `when`, `until` and the actions of a rule."""
    if spec.scope.pairs is not None:
        return pairs_environment()
    return client_environment(tuple(signal.name for signal in spec.signals if not is_taken(signal.name)))
