"""The subjects of a rule, and the variables of its conditions."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import permutations
from typing import Any

from tests.reference.episodes import Truth
from tests.reference.samples import SECOND, Received
from tests.reference.signals import nanoseconds, truth

MEMBER = ("client", "labels", "streams")

Subject = tuple[tuple[str, ...], str | None]
"""Clients, and the element."""


@dataclass(frozen=True)
class SubjectView:
    """A subject and the variables of its conditions."""

    subject: Subject
    variables: dict[str, Any]
    names: tuple[str, ...]
    in_scope: Truth
    near: Truth
    values: dict[str, Any]


def text(subject: Subject) -> str:
    """As in events."""
    clients, element = subject
    return ("+".join(clients) or "~fleet") + ("" if element is None else f"~{element}")


def _uses(spec: dict[str, Any], word: str) -> bool:
    """Whether a condition of the rule has the word."""
    return any(word in str(spec.get(field, "")) for field in ("when", "until", "scope", "signals"))


def looks(
    spec: dict[str, Any], received: Received, now: int, view: Callable[[str], dict[str, Any]]
) -> Iterator[SubjectView]:
    """All subjects that a rule can be about now."""
    views = {client: view(client) for client in sorted(received.known)}
    signals = [signal["name"] for signal in spec.get("signals", []) if "stream" in signal or "ruleName" in signal]
    each = spec.get("each")
    for element in [None] if each is None else each["of"]:
        extra = {} if element is None else {each["as"]: element}
        name = None if element is None else element["name"]
        scope = spec.get("scope", {"client": {}})
        if "client" in scope:
            yield from _clients(scope["client"], views, signals, extra, name)
        elif "pairs" in scope:
            pairs = {**scope["pairs"], "closing": _uses(spec, "closingSpeed")}
            yield from _pairs(pairs, views, signals, extra, name, received, now)
        else:
            yield _fleet(scope["fleet"], views, signals, extra, name)


def _clients(
    scope: dict[str, Any],
    views: dict[str, dict[str, Any]],
    signals: list[str],
    extra: dict[str, Any],
    element: str | None,
) -> Iterator[SubjectView]:
    for client, view in views.items():
        variables = {**view, **extra}
        in_scope = truth(scope.get("where"), variables, (*MEMBER, *extra))
        yield SubjectView(
            ((client,), element), variables, (*MEMBER, *signals, *extra), in_scope, True, only(view, signals)
        )


def _fleet(
    scope: dict[str, Any],
    views: dict[str, dict[str, Any]],
    signals: list[str],
    extra: dict[str, Any],
    element: str | None,
) -> SubjectView:
    names = (*MEMBER, *signals, *extra)
    members = [view for view in views.values() if truth(scope["members"], {**view, **extra}, names) is True]
    values = {
        "count": float(len(members)),
        "members": [only(view, ["client", *signals]) for view in members],
    }
    return SubjectView(((), element), {"members": members, **extra}, ("members", *extra), True, True, values)


def _pairs(
    scope: dict[str, Any],
    views: dict[str, dict[str, Any]],
    signals: list[str],
    extra: dict[str, Any],
    element: str | None,
    received: Received,
    now: int,
) -> Iterator[SubjectView]:
    ordered = "a" in scope or "b" in scope
    places = {client: _place(scope["position"], client, received, now, now) for client in views}
    placed = {
        client: view if places[client] is None else {**view, "position": dict(zip("xyz", places[client], strict=True))}
        for client, view in views.items()
    }
    names = ("a", "b", "distance", "closingSpeed", *extra)
    for a, b in permutations(views, 2):
        if not ordered and a > b:
            continue
        variables: dict[str, Any] = {"a": placed[a], "b": placed[b], **extra}
        near: Truth = None
        distance = _distance(places[a], places[b])
        if distance is not None:
            variables["distance"] = distance
            near = distance <= scope["within"]
            closing = _closing_speed(scope["position"], a, b, received, now) if scope["closing"] else None
            if closing is not None:
                variables["closingSpeed"] = closing
        roles = [
            truth(scope[role]["where"], {**views[client], **extra}, (*MEMBER, *extra))
            for role, client in (("a", a), ("b", b))
            if role in scope
        ]
        in_scope = both(*roles, truth(scope.get("where"), variables, names))
        values = {role: only(variables[role], ["client", "position", *signals]) for role in ("a", "b")}
        values |= only(variables, ["distance", "closingSpeed"])
        yield SubjectView(((a, b), element), variables, names, in_scope, near, values)


def _distance(one: tuple[float, ...] | None, other: tuple[float, ...] | None) -> float | None:
    if one is None or other is None:
        return None
    dx, dy, dz = (p - q for p, q in zip(one, other, strict=True))
    return math.sqrt(dx * dx + dy * dy + dz * dz)


def _closing_speed(position: dict[str, str], a: str, b: str, received: Received, now: int) -> float | None:
    """The decrease of the distance in the latest second for which both have sent their positions."""
    end = now
    if _limits(position, received) != []:
        end = min(received.kept(client, position["stream"], now)[-1].time for client in (a, b))
    before, after = (
        _distance(*(_place(position, client, received, time, now) for client in (a, b))) for time in (end - SECOND, end)
    )
    return None if before is None or after is None else before - after


def _limits(position: dict[str, str], received: Received) -> list[int]:
    """The age limits of a position; none if it never expires."""
    stale = received.stale_after[position["stream"]]
    oldest = nanoseconds(position["maxAge"]) if "maxAge" in position else None if stale is None else SECOND
    return [limit for limit in (stale, oldest) if limit is not None]


def _place(position: dict[str, str], client: str, received: Received, then: int, now: int) -> tuple[float, ...] | None:
    """Where the client was; of the past, no more than the buffer has and not from before a gap."""
    mine = [each for each in received.kept(client, position["stream"], now) if each.time <= then]
    if then < now:
        mine = [each for each in mine if received.floor is None or each.time > received.floor]
    if not mine or any(then - mine[-1].time > limit for limit in _limits(position, received)):
        return None
    if mine[-1].message is None:
        return None
    seen = {"msg": mine[-1].message, "item": mine[-1].item}
    read = [position[axis].split(".") for axis in ("x", "y")]
    axes = [seen[variable].get(field) for variable, field in read]
    if not all(isinstance(axis, float) and abs(axis) <= 1e12 for axis in axes):
        return None
    return (axes[0], axes[1], 0.0)


def only(view: dict[str, Any], names: list[str]) -> dict[str, Any]:
    """The known values of these names."""
    return {name: view[name] for name in names if name in view}


def both(*values: Truth) -> Truth:
    """Kleene's and."""
    return False if False in values else None if None in values else True
