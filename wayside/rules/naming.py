"""Checks the names of signals and elements, and proposes another name if one is not allowed."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from wayside.api.eventrule import EventRuleSpec
from wayside.expressions import RESERVED_WORDS
from wayside.rules.variables import is_taken

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
    """Why a signal cannot have the name, and which it could have; None where it can."""
    return _problem(name, spec, _given(spec), "signal")


def element_name_problem(name: str, spec: EventRuleSpec) -> str | None:
    """Why the element of `each` cannot have the name, and which it could have; None where it can."""
    problem = _problem(name, spec, {**_given(spec), **_SAMPLE}, "element")
    if problem is None and any(signal.name == name for signal in spec.signals):
        return f"{name} is also the name of a signal: rename one of them, e.g. to {_free(name, spec, {}, 'element')}"
    return problem


def _given(spec: EventRuleSpec) -> Mapping[str, str]:
    """The names that the rule's scope gives to expressions, and what they are."""
    if spec.scope.pairs is not None:
        return {**_CLIENT, **_PAIRS}
    return {**_CLIENT, **(_FLEET if spec.scope.fleet is not None else {})}


def _problem(name: str, spec: EventRuleSpec, given: Mapping[str, str], kind: str) -> str | None:
    if name in given:
        giver = "a sample" if name in _SAMPLE else f"the scope {_scope(spec)}"
        why = f"{giver} already defines the variable {name}: {given[name]}"
    elif name in RESERVED_WORDS:
        why = f"{name} is a reserved word of CEL"
    elif is_taken(name):
        why = f"{name} is the name of a CEL type"
    else:
        return None
    return f"{why}; choose another name, such as {_free(name, spec, given, kind)}"


def _scope(spec: EventRuleSpec) -> str:
    return "pairs" if spec.scope.pairs is not None else "fleet" if spec.scope.fleet is not None else "client"


_ENDINGS: Mapping[str, str] = MappingProxyType({"signal": "Value", "element": "Element"})


def _free(name: str, spec: EventRuleSpec, given: Mapping[str, str], kind: str) -> str:
    """A name like this one that is free."""
    used = {*given, *(signal.name for signal in spec.signals), *(() if spec.each is None else (spec.each.as_,))}
    proposal = name + _ENDINGS[kind]
    number = 2
    while proposal in used:
        proposal, number = f"{name}{_ENDINGS[kind]}{number}", number + 1
    return proposal
