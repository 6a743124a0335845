"""Constraints between fields, each defined once for the API server, which checks it in CEL, and for the programs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

from pydantic.alias_generators import to_camel
from pydantic.config import JsonDict


class Constraint(NamedTuple):
    """A condition that every object of a model must meet."""

    validation: JsonDict | None
    """For the CRD; None: only the programs check it."""
    problem: Callable[[Any], str | None]
    """Returns the problem of an object, with the remedy; None if it meets the condition."""


def validation(rule: str, message: str, field: str = "", reason: str = "") -> JsonDict:
    """A CEL validation for the CRD.

    Args:
        rule: the CEL source.
        message: the problem and the remedy.
        field: the path of the field that the error names, relative to the object, e.g. `.over`; empty: the object
            itself, for a rule about several fields of equal rank.
        reason: Required, Forbidden or Duplicate; empty: Invalid.
    """
    made: JsonDict = {"rule": rule, "message": message}
    return made | ({"fieldPath": field} if field else {}) | ({"reason": f"FieldValue{reason}"} if reason else {})


def checked(rule: str, message: str, reason: str = "") -> JsonDict:
    """A validation of one field, to be added to its schema."""
    return {"x-kubernetes-validations": [validation(rule, message, reason=reason)]}


def immutable(message: str) -> JsonDict:
    """A field that cannot change, with the remedy in the message."""
    return checked("self == oldSelf", message, "Forbidden")


def constraint(
    rule: str, message: str, field: str = "", reason: str = "", *, holds: Callable[[Any], bool] = lambda _: True
) -> Constraint:
    """As `validation`.

    `holds` is the rule in Python; without it, a validator of the model checks the rule in more detail.
    """
    return Constraint(validation(rule, message, field, reason), lambda given: None if holds(given) else message)


def exactly_one(*fields: str) -> Constraint:
    """Exactly one of these fields must be given."""
    has = [f"has(self.{to_camel(field)})" for field in fields]
    rule = " != ".join(has) if len(has) == 2 else f"[{', '.join(has)}].filter(given, given).size() == 1"
    *names, last = map(to_camel, fields)
    message = f"give exactly one of {', '.join(names)} and {last}"
    return constraint(rule, message, holds=lambda given: sum(_has(given, field) for field in fields) == 1)


def not_both(field: str, other: str) -> Constraint:
    """At most one of two fields may be given."""
    one, two = to_camel(field), to_camel(other)
    return constraint(
        f"!(has(self.{one}) && has(self.{two}))",
        f"give {one} or {two}, not both",
        f".{two}",
        "Forbidden",
        holds=lambda given: not (_has(given, field) and _has(given, other)),
    )


def unique(
    *fields: str, by: str = "name", wording: str = "the name {!r} is used twice: names must be unique"
) -> Constraint:
    """The items of each of these lists must differ in a field; strings must differ themselves.

    The API server checks this by the list type. `wording` is the message, with a placeholder for the repeated value.
    """

    def problem(given: Any) -> str | None:
        for field in fields:
            counted = Counter(getattr(item, by, item) for item in getattr(given, field) or ())
            for name in sorted(name for name, count in counted.items() if count > 1):
                return f"{to_camel(field)}: {wording.format(name)}"
        return None

    return Constraint(None, problem)


GIVEN_TWICE = "{} is given twice: give it once"
"""Another wording for `unique`."""


def _has(given: Any, field: str) -> bool:
    return getattr(given, field) not in (None, [])
