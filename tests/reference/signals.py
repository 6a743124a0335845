"""Signals, computed from all samples of a client."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

from tests.reference.aggregates import NOTHING, aggregated
from tests.reference.places import PlaceContext, with_fields
from tests.reference.samples import SECOND, Received
from wayside.expressions import UNKNOWN, CelType, Environment, Expression

VARIABLES = ("msg", "item", "before", "key", "sample")
"""The variables of expressions over one sample."""


@cache
def _compiled(source: str, names: tuple[str, ...]) -> Expression:
    return Environment(dict.fromkeys(names, CelType.DYN)).compile(source)


def truth(source: str | None, variables: dict[str, Any], names: Iterable[str]) -> bool | None:
    """The result of a condition; None is unknown, and one that is absent holds."""
    if source is None:
        return True
    value = evaluated(source, variables, tuple(names))
    return value if isinstance(value, bool) else None


_WHERE = PlaceContext({}, {})


def set_places(places: Iterable[dict[str, Any]], position: dict[str, str]) -> None:
    """The places that expressions name, and the position of a sample."""
    _WHERE.places.update({place["name"]: place for place in places})
    _WHERE.position.update(position)


def evaluated(source: str, variables: dict[str, Any], names: tuple[str, ...]) -> Any:
    """The result of an expression; NOTHING is unknown."""
    source, variables, more = with_fields(source, variables, _WHERE)
    value = _compiled(source, (*names, *more)).evaluate_or_unknown(variables)
    return NOTHING if value is UNKNOWN else value


@dataclass(frozen=True)
class Start:
    """The start of a rule's episode. `clients` is None for all clients."""

    rule: str
    time: int
    clients: tuple[str, ...] | None
    message: dict[str, Any]
    ends: bool = False
    """Whether it is the end of the episode instead."""


@dataclass(frozen=True)
class Item:
    """The input of a signal: a sample or a start."""

    time: int
    message: Any
    """None if the sample cannot be decoded."""
    sample: dict[str, float]
    item: Any = None
    before: Any = None


def of_rule(signal: dict[str, Any]) -> tuple[str, bool]:
    """The rule whose episodes are the input of a signal, and whether their ends are, not their starts."""
    return signal["ruleName"], signal.get("samples") == "Ends"


@dataclass
class Sources:
    """The inputs of signals."""

    received: Received
    starts: list[Start]
    """In order; those of a client that was lost since are not its own any more."""
    open_of: dict[str, list[tuple[str, ...] | None]]
    """By rule that is evaluated: the clients of each episode that is open."""
    keep_starts: dict[tuple[str, bool], int]

    def signal(self, signal: dict[str, Any], client: str, now: int, ticks: list[int]) -> Any:
        """The value at a tick; `ticks` are those at which the rule was evaluated for the client, this one included."""
        aggregate = signal.get("aggregate", "Last")
        if "client" in signal:
            client = signal["client"]
            if client not in self.received.known:
                return NOTHING
        if "ruleName" in signal:
            if signal["ruleName"] not in self.open_of:
                return NOTHING
            if aggregate == "Active":
                return any(clients is None or client in clients for clients in self.open_of[signal["ruleName"]])
        if aggregate == "Age":
            return self._age(signal, client, now, ticks)
        always_known = "ruleName" in signal or aggregate in ("Count", "Any")
        if not always_known and not self.received.fresh(client, signal["stream"], now):
            return NOTHING
        window = list(self._picked(signal, self._items(signal, client, now)))
        if "over" in signal:
            after = now - nanoseconds(signal["over"])
            if self.received.floor is not None:
                after = max(after, self.received.floor)
            window = [item for item in window if item.time > after]
        return aggregated(aggregate, [(item.time, _value(signal, item)) for item in window], signal.get("quantile"))

    def _age(self, signal: dict[str, Any], client: str, now: int, ticks: list[int]) -> float:
        if "where" not in signal and "stream" in signal:
            times = [each.time for each in self.received.of(client, signal["stream"], now)]
        else:
            seen = [item for tick in ticks for item in self._items(signal, client, tick)]
            times = [item.time for item in self._picked(signal, seen)]
        return (now - max(times, default=self.received.known[client].since)) / SECOND

    def _items(self, signal: dict[str, Any], client: str, now: int) -> list[Item]:
        if "stream" in signal:
            return [
                Item(
                    each.time,
                    each.message,
                    {"received": each.received / SECOND, "size": float(len(each.payload))},
                    each.item,
                    each.before,
                )
                for each in self.received.kept(client, signal["stream"], now)
            ]
        mine = [
            each
            for each in self.starts
            if (each.rule, each.ends) == of_rule(signal)
            and each.time <= now
            and (each.clients is None or client in each.clients)
        ]
        kept = [each for each in mine if each.time > now - self.keep_starts[of_rule(signal)]] or mine[-1:]
        return [Item(each.time, each.message, {"received": each.time / SECOND}) for each in kept]

    def _picked(self, signal: dict[str, Any], items: list[Item]) -> Iterator[Item]:
        for item in items:
            if truth(signal.get("where"), _variables(item), VARIABLES) is True:
                yield item


def _value(signal: dict[str, Any], item: Item) -> Any:
    return evaluated(signal["value"], _variables(item), VARIABLES) if "value" in signal else True


def _variables(item: Item) -> dict[str, Any]:
    known = {"key": {}, "sample": item.sample}
    known |= {name: each for name, each in (("item", item.item), ("before", item.before)) if each is not None}
    return known if item.message is None else {"msg": item.message, **known}


def nanoseconds(text: str) -> int:
    """A duration."""
    for unit, factor in (("ms", 10**6), ("s", SECOND), ("m", 60 * SECOND), ("h", 3600 * SECOND)):
        if text.endswith(unit):
            return int(text[: -len(unit)]) * factor
    raise ValueError(text)
