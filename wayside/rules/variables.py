"""The variables that each kind of expression of a rule may use."""

from __future__ import annotations

from functools import cache, lru_cache

from wayside.api.eventrule import EventRuleSpec
from wayside.expressions import CelType, Environment, ExpressionError
from wayside.rules.fields import Fields

MEMBER_OF_CLIENT = ("client", "labels", "streams", "parameters")

EPISODE_MEMBERS: Fields = dict.fromkeys(
    ("episode", "subject", "subjects", "element", "onsetTime", "startTime", "values")
)
"""The fields of msg in a signal over a rule: the start of an episode. Times are seconds since the epoch."""

END_MEMBERS: Fields = {**EPISODE_MEMBERS, "endTime": None, "reason": None}
"""The same of the end of an episode."""

SAMPLE_MEMBERS = ("stamp", "received", "latency", "size")


@lru_cache(maxsize=256)
def sample_environment(element: str | None = None, *, items: bool = False, before: bool = True) -> Environment:
    """For `value` and `where` of signals, and positions (without an element): one sample.

    msg is the decoded message, key the captured chunks, sample has stamp and received (seconds since the epoch),
    latency (seconds) and size (bytes); parameters are those of the sample's client. `items`: item is the client's item.
    `before`: before is the client's message or item before.
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
    """For a stream's `stamp`: the decoded message, and when the sample was received."""
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
def is_taken(name: str) -> bool:
    """Whether the name means something to CEL itself, so that no signal can have it."""
    try:
        Environment({name: CelType.DYN}).compile(name)
    except (ValueError, ExpressionError):
        return True
    return False


@lru_cache(maxsize=256)
def client_environment(signals: tuple[str, ...] = (), element: str | None = None) -> Environment:
    """For one client: client, labels, streams (those that are not stale), the signals and the element of `each`."""
    fixed = {"client": CelType.STRING, "labels": CelType.MAP, "streams": CelType.LIST, "parameters": CelType.MAP}
    return Environment(_with_element({**dict.fromkeys(signals, CelType.DYN), **fixed}, element))


@lru_cache(maxsize=256)
def pairs_environment(element: str | None = None) -> Environment:
    """For a pair: a and b (maps of what a client scope has, and position), distance in metres, closingSpeed in m/s."""
    numbers = {"distance": CelType.DOUBLE, "closingSpeed": CelType.DOUBLE}
    return Environment(
        _with_element({"a": CelType.MAP, "b": CelType.MAP, "parameters": CelType.MAP, **numbers}, element)
    )


@lru_cache(maxsize=256)
def fleet_environment(element: str | None = None) -> Environment:
    """For the fleet: members (a list of maps of what a client scope has)."""
    return Environment(_with_element({"members": CelType.LIST, "parameters": CelType.MAP}, element))


def _with_element(variables: dict[str, CelType], name: str | None) -> dict[str, CelType]:
    """Adds the element of `each`; an element with an invalid name is skipped, and reported elsewhere."""
    return variables if name is None or name in variables or is_taken(name) else {**variables, name: CelType.MAP}


def element_of(spec: EventRuleSpec) -> str | None:
    """The variable of the element of `each`."""
    return None if spec.each is None else spec.each.as_


def signal_names(spec: EventRuleSpec) -> tuple[str, ...]:
    """The signals that each client has and that expressions can name."""
    whole = of_the_subject(spec)
    return tuple(each.name for each in spec.signals if each.name not in whole and not is_taken(each.name))


def of_the_subject(spec: EventRuleSpec) -> frozenset[str]:
    """The signals that the rule's subject has as a whole: in a pairs scope, neither a nor b has them."""
    margin = ("margin",) if spec.margin is not None else ()
    named = (signal.name for signal in spec.signals if signal.plugin is not None or signal.is_derived)
    return frozenset((*named, *margin))


def condition_environment(spec: EventRuleSpec) -> Environment:
    """For `when`, `until` and the actions of a rule."""
    whole = tuple(sorted(name for name in of_the_subject(spec) if not is_taken(name)))
    return _with(_scope_environment(spec), whole) if whole else _scope_environment(spec)


@lru_cache(maxsize=256)
def _with(environment: Environment, whole: tuple[str, ...]) -> Environment:
    """And the signals that the subject has as a whole."""
    return Environment({**environment.variables, **dict.fromkeys(whole, CelType.DYN)})


def _scope_environment(spec: EventRuleSpec) -> Environment:
    """The variables of the scope."""
    element = element_of(spec)
    if spec.scope.pairs is not None:
        return pairs_environment(element)
    if spec.scope.fleet is not None:
        return fleet_environment(element)
    return client_environment(signal_names(spec), element)
