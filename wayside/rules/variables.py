"""The variables of each kind of expression of a rule."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache, lru_cache
from typing import Any

from wayside.api.eventrule import EventRuleSpec
from wayside.expressions import RESERVED_WORDS, CelType, Environment, ExpressionError
from wayside.rules.fields import Fields

MEMBER_OF_CLIENT = ("client", "labels", "streams", "parameters")

EPISODE_MEMBERS: Fields = dict.fromkeys(
    ("episode", "subject", "subjects", "element", "onsetTime", "startTime", "values")
)
"""The fields of msg in a signal over the episode starts of a rule. Times are in seconds since the epoch."""

END_MEMBERS: Fields = {**EPISODE_MEMBERS, "endTime": None, "reason": None}
"""The fields of msg in a signal over the episode ends of a rule."""

SAMPLE_MEMBERS = ("stamp", "received", "latency", "size")


@lru_cache(maxsize=256)
def sample_environment(element: str | None = None, *, items: bool = False, before: bool = True) -> Environment:
    """For `value` and `where` of signals, and for positions (without an element): the variables of one sample.

    msg is the decoded message, key has the captured chunks, sample has stamp and received (seconds since the epoch),
    latency (seconds) and size (bytes); parameters are those of the sample's client. With `items`, item is the client's
    item. With `before`, before is the client's previous message or item.
    """
    fixed = {"msg": CelType.DYN, "key": CelType.MAP, "sample": CelType.MAP, "parameters": CelType.MAP}
    if items:
        fixed["item"] = CelType.DYN
    if before:
        fixed["before"] = CelType.DYN
    members = {f"sample.{member}": CelType.DOUBLE for member in SAMPLE_MEMBERS}
    return Environment(_with_element(fixed, element), members)


@cache
def stamp_environment() -> Environment:
    """For a stream's `stamp`: the decoded message, and the receive time of the sample."""
    return Environment({"msg": CelType.DYN, "sample": CelType.MAP}, {"sample.received": CelType.DOUBLE})


@cache
def items_environment() -> Environment:
    """For a stream's `items`: the decoded message."""
    return Environment({"msg": CelType.DYN})


@cache
def naming_environment(*, items: bool = False) -> Environment:
    """For a stream's `client`: the decoded message, the captured chunks of its key, and with `items` the item."""
    return Environment({"msg": CelType.DYN, "key": CelType.MAP, **({"item": CelType.DYN} if items else {})})


@lru_cache(maxsize=1024)
def is_reserved(name: str) -> bool:
    """Whether the name is reserved, because it has a meaning in CEL: no signal can have it."""
    try:
        Environment({name: CelType.DYN}).compile(name)
    except (ValueError, ExpressionError):
        return True
    return False


@lru_cache(maxsize=256)
def client_environment(signals: tuple[str, ...], element: str | None) -> Environment:
    """For one client: client, labels, streams (those that are not stale), the signals and the element of `each`."""
    fixed = {"client": CelType.STRING, "labels": CelType.MAP, "streams": CelType.LIST, "parameters": CelType.MAP}
    return Environment(_with_element({**dict.fromkeys(signals, CelType.DYN), **fixed}, element))


@lru_cache(maxsize=256)
def pairs_environment(element: str | None) -> Environment:
    """For a pair: a and b (maps of a client scope's variables, with position), distance (m), closingSpeed (m/s)."""
    numbers = {"distance": CelType.DOUBLE, "closingSpeed": CelType.DOUBLE}
    return Environment(
        _with_element({"a": CelType.MAP, "b": CelType.MAP, "parameters": CelType.MAP, **numbers}, element)
    )


@lru_cache(maxsize=256)
def fleet_environment(element: str | None) -> Environment:
    """For the fleet: members (a list of maps of the variables of a client scope)."""
    return Environment(_with_element({"members": CelType.LIST, "parameters": CelType.MAP}, element))


def _with_element(variables: dict[str, CelType], name: str | None) -> dict[str, CelType]:
    """Adds the element of `each`. An invalid name is skipped here, and reported elsewhere."""
    return variables if name is None or name in variables or is_reserved(name) else {**variables, name: CelType.MAP}


def element_of(spec: EventRuleSpec) -> str | None:
    """The variable of the element of `each`."""
    return None if spec.each is None else spec.each.as_


def signal_names(spec: EventRuleSpec) -> tuple[str, ...]:
    """The signals of each client that expressions can name."""
    whole = of_the_subject(spec)
    return tuple(each.name for each in spec.signals if each.name not in whole and not is_reserved(each.name))


def of_the_subject(spec: EventRuleSpec) -> frozenset[str]:
    """The signals that belong to the rule's subject as a whole. In a pairs scope, a and b do not have them."""
    margin = ("margin",) if spec.margin is not None else ()
    named = (signal.name for signal in spec.signals if signal.plugin is not None or signal.is_derived)
    return frozenset((*named, *margin))


def condition_environment(spec: EventRuleSpec) -> Environment:
    """For `when`, `until` and the actions of a rule."""
    whole = tuple(sorted(name for name in of_the_subject(spec) if not is_reserved(name)))
    return _with(_scope_environment(spec), whole) if whole else _scope_environment(spec)


@lru_cache(maxsize=256)
def _with(environment: Environment, whole: tuple[str, ...]) -> Environment:
    """The environment with the signals of the subject as a whole."""
    return Environment({**environment.variables, **dict.fromkeys(whole, CelType.DYN)})


def _scope_environment(spec: EventRuleSpec) -> Environment:
    """The variables of the scope."""
    element = element_of(spec)
    if spec.scope.pairs is not None:
        return pairs_environment(element)
    if spec.scope.fleet is not None:
        return fleet_environment(element)
    return client_environment(signal_names(spec), element)


def known_members(spec: EventRuleSpec) -> Iterator[tuple[str, Fields]]:
    """The map variables whose fields are known, with these fields: CEL does not check them."""
    yield "parameters", dict.fromkeys(spec.parameters)
    if spec.scope.pairs is not None:
        whole = of_the_subject(spec)
        signals = (signal.name for signal in spec.signals if signal.name not in whole)
        member: dict[str, Any] = dict.fromkeys((*MEMBER_OF_CLIENT, *signals))
        position = spec.scope.pairs.position
        axes = ("latitude", "longitude") if position.latitude is not None else ("x", "y", "z")
        member["parameters"] = dict.fromkeys(spec.parameters)
        member["position"] = dict.fromkeys(axes) if position.x or position.latitude else None
        yield "a", member
        yield "b", member
    if spec.each is not None:
        # A field that only some elements have is unknown for the others.
        yield spec.each.as_, dict.fromkeys(name for element in spec.each.of for name in element.to_json())


# The names of signals and elements

_CLIENT = {
    "client": "the client's name",
    "labels": "the client's labels",
    "streams": "the streams that are not stale",
    "parameters": "the rule's parameters",
}
_PAIRS = {
    "a": "the first of the two",
    "b": "the second of the two",
    "position": "where a client is",
    "distance": "the distance of the two in metres",
    "closingSpeed": "how fast the two approach each other",
}
_FLEET = {"members": "the list of the clients that belong to it"}
_SAMPLE = {
    "msg": "the message",
    "item": "the item of the message's list",
    "before": "the message or item before",
    "key": "what the key captures",
    "sample": "the sample's times and size",
}


def signal_name_problem(name: str, spec: EventRuleSpec) -> str | None:
    """The reason why a signal cannot have the name, with a proposal; None if it can."""
    return _problem(name, spec, _given(spec), "signal")


def element_name_problem(name: str, spec: EventRuleSpec) -> str | None:
    """The reason why the element of `each` cannot have the name, with a proposal; None if it can."""
    problem = _problem(name, spec, {**_given(spec), **_SAMPLE}, "element")
    if problem is None and any(signal.name == name for signal in spec.signals):
        return f"{name} is also the name of a signal: rename one of them, e.g. to {_free(name, spec, {}, 'element')}"
    return problem


def _given(spec: EventRuleSpec) -> Mapping[str, str]:
    """The variables that the rule's scope defines, with their meanings."""
    if spec.scope.pairs is not None:
        return {**_CLIENT, **_PAIRS}
    return {**_CLIENT, **(_FLEET if spec.scope.fleet is not None else {})}


def _problem(name: str, spec: EventRuleSpec, given: Mapping[str, str], kind: str) -> str | None:
    if name in given:
        giver = "a sample" if name in _SAMPLE else f"the scope {_scope(spec)}"
        why = f"{giver} already defines the variable {name}: {given[name]}"
    elif name in RESERVED_WORDS:
        why = f"{name} is a reserved word of CEL"
    elif is_reserved(name):
        why = f"{name} is the name of a CEL type"
    else:
        return None
    return f"{why}; choose another name, such as {_free(name, spec, given, kind)}"


def _scope(spec: EventRuleSpec) -> str:
    return "pairs" if spec.scope.pairs is not None else "fleet" if spec.scope.fleet is not None else "client"


_ENDINGS = {"signal": "Value", "element": "Element"}


def _free(name: str, spec: EventRuleSpec, given: Mapping[str, str], kind: str) -> str:
    """A free name that is similar to this one."""
    used = {*given, *(signal.name for signal in spec.signals), *(() if spec.each is None else (spec.each.as_,))}
    proposal = name + _ENDINGS[kind]
    number = 2
    while proposal in used:
        proposal, number = f"{name}{_ENDINGS[kind]}{number}", number + 1
    return proposal
