"""Finds the class of an action, and validates its parameters.

Built-in actions are found in the same way as those of other packages. Their parameters are fields of the rule, so they
are valid once the rule is read.

An author of rules can have the value of a Secret sent anywhere. Therefore rules cannot use a Secret that the Detector
names for its own use, unless `pod.secretNames` of the Detector lists it for rules as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from pydantic import BaseModel

from detector.actions.base import Action
from detector.plugins.entrypoints import PluginClasses, PluginError
from wayside.api import Detector, EventRule
from wayside.api.actions import action as api
from wayside.rules import RuleProblem

OFFERS = PluginClasses[Action[Any]](
    group="wayside.actions", noun="action", base=Action, model=BaseModel, guide="docs/actions.md"
)

DEPLOY = "deploy"
"""The one action without a class here: its tasks are reconciled (detector/actions/deploy)."""


def prepare_action(action: api.ActionSpec, streams: Sequence[str] | None = None) -> tuple[type[Action[Any]], BaseModel]:
    """The class of an action other than deploy, and its parameters; `streams` are those that parameters may name.

    Raises PluginError; the paths begin at the action.
    """
    if action.plugin is None:
        offered = OFFERS.load(action.kind, (action.field,))
        given = action.parameters
        if not isinstance(given, offered.Parameters):
            wanted = f"{offered.Parameters.__module__}.{offered.Parameters.__name__}"
            raise PluginError(
                (
                    (action.field,),
                    f"the installed action {action.kind} requires parameters of {wanted}; got {type(given).__name__}",
                )
            )
        return offered, given
    name = action.plugin.name
    if name in api.ActionSpec.model_fields:
        raise PluginError(
            (
                ("plugin", "name"),
                f"{name} is a built-in action, not a plugin: write {name}: {{…}} instead of plugin: {{…}}",
            )
        )
    offered = OFFERS.load(name, ("plugin", "name"))
    context = {"streams": None if streams is None else list(streams)}
    return offered, OFFERS.parameters(offered, action.plugin.parameters, ("plugin", "parameters"), context)


def action_problems(rule: EventRule, detector: Detector) -> Iterator[RuleProblem]:
    """The problems of a rule's actions, as far as their classes can check here."""
    yield from secret_problems(rule, detector)
    streams = [stream.name for stream in detector.spec.streams]
    for index, action in enumerate(rule.spec.actions):
        if action.field != DEPLOY:
            at = ("spec", "actions", index)
            try:
                offered, parameters = prepare_action(action, streams)
            except PluginError as error:
                for path, text in error.problems:
                    yield RuleProblem((*at, *path), text)
            else:
                below = (action.field,) if action.plugin is None else ("plugin", "parameters")
                for path, text in offered.problems(parameters, detector):
                    yield RuleProblem((*at, *below, *path), text)


_OWN = frozenset({"tlsSecretName", "credentialsSecretName", "uriSecretName"})
"""Fields that name a Secret in a Detector and in the parameters of its sources."""

_OF_RULES = _OWN | {"secretKeyRef", "urlSecretKeyRef"}
"""Fields that name a Secret in an action, by name or as name and key."""

Place = tuple[str | int, ...]


def secret_problems(rule: EventRule, detector: Detector) -> Iterator[RuleProblem]:
    """The fields in which a rule names one of the detector's own Secrets."""
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
