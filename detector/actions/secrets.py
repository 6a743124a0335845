"""Which Secrets a rule may use: not those by which the detector itself accesses networks and databases.

An author of rules can have the value of a Secret sent anywhere. Therefore rules cannot use a Secret that the Detector
names for its own use, unless `pod.secretNames` of the Detector lists it for rules as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from wayside.api import Detector, EventRule
from wayside.rules import RuleProblem

_OWN = frozenset({"tlsSecretName", "credentialsSecretName", "uriSecretName"})
"""Fields that name a Secret in a Detector and in the parameters of its sources."""

_OF_RULES = _OWN | {"secretKeyRef", "urlSecretKeyRef"}
"""Fields that name a Secret in an action, by name or as name and key."""

Place = tuple[str | int, ...]


def secret_problems(rule: EventRule, detector: Detector) -> Iterator[RuleProblem]:
    """The places at which a rule names one of the detector's own Secrets."""
    pod = detector.spec.pod
    given = set() if pod is None else {*pod.secret_names}
    own = {name for _, name in _named(detector.spec.to_json(), _OWN, ())} - given
    if not own:
        return
    for index, action in enumerate(rule.to_json()["spec"].get("actions", [])):
        for place, name in _named(action, _OF_RULES, ("spec", "actions", index)):
            if name in own:
                yield RuleProblem(
                    place,
                    (
                        f"the Secret {name} contains the network credentials of the Detector itself: use another "
                        "Secret, or share this one with rules in spec.pod.secretNames"
                    ),
                )


def _named(value: Any, fields: frozenset[str], place: Place) -> Iterator[tuple[Place, str]]:
    if isinstance(value, list):
        for index, each in enumerate(value):
            yield from _named(each, fields, (*place, index))
    if not isinstance(value, dict):
        return
    for key, child in value.items():
        at = (*place, key)
        if key in fields and isinstance(child, str):
            yield at, child
        elif key in fields and isinstance(child, dict) and isinstance(child.get("name"), str):
            yield (*at, "name"), child["name"]
        else:
            yield from _named(child, fields, at)
