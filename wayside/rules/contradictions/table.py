"""The table of contradictions between the values of a dimension and the fields of a rule.

It contains only certain contradictions. No field of a rule can contradict a value of the overarching purpose, the data
source entity, the affected entity or the scope of impact. If several values are given in a dimension, one that fits is
enough.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

from wayside.api import Detector, EventRule
from wayside.api.actions.action import ActionSpec
from wayside.api.classification import (
    ActingEntity,
    CharacteristicValue,
    DetectionAlgorithm,
    EventDetectionEntity,
    Incidence,
    NumberOfParticipants,
    ObservationPeriod,
    TimeSensitivity,
    TypeOfAction,
    TypeOfParticipants,
)
from wayside.api.operation import Operation
from wayside.rules.compiled import CompiledRule, FleetSubject, PairSubject
from wayside.rules.contradictions.case import Case, detecting, span
from wayside.rules.contradictions.observation import looks_back, observation
from wayside.rules.problems import RuleProblem

_COUPLE_OF_SECONDS = 2 * 10**9
_HOUR = 3_600 * 10**9

_SENDERS = {
    "etsi/vam": TypeOfParticipants.VRU,
    "etsi/spatem": TypeOfParticipants.ROAD_INFRASTRUCTURE,
    "etsi/mapem": TypeOfParticipants.ROAD_INFRASTRUCTURE,
}
"""The only senders of these messages, according to ETSI TS 103 300-3 (VAM) and ETSI TS 103 301 (SPATEM and MAPEM)."""


@dataclass(frozen=True)
class Contradiction:
    """One way in which a classification can be wrong."""

    check: str
    """The name of its finding."""
    dimension: type[CharacteristicValue]
    description: str
    """The condition of the warning, for people."""
    find: Callable[[Case], Iterator[RuleProblem]]


def contradictions(
    rule: EventRule, compiled: CompiledRule, detector: Detector, others: Mapping[str, EventRule]
) -> list[RuleProblem]:
    """Every contradiction of a rule that compiles; none if it has no classification.

    Args:
        rule: the rule as written.
        compiled: the same rule, compiled.
        detector: the Detector against which it was compiled.
        others: the rules that it can name, by name.
    """
    if rule.spec.classification is None:
        return []
    case = Case(rule, compiled, detector, others)
    return [replace(problem, check=each.check) for each in CONTRADICTIONS for problem in each.find(case)]


def _senders(case: Case) -> Iterator[RuleProblem]:
    given = case.given(TypeOfParticipants)
    for name in sorted(case.compiled.streams):
        stream = case.detector.spec.stream(name)
        sender = _SENDERS.get(stream.type or "") if stream is not None else None
        if given and sender is not None and sender not in given:
            yield case.lacks(
                TypeOfParticipants,
                f"the messages of the stream {name} ({stream.type if stream else ''}) are sent by "
                f"{sender.explained()}: add it",
            )


def _one_of_several(case: Case) -> Iterator[RuleProblem]:
    one = NumberOfParticipants.ONE
    if not case.only(one):
        return
    if isinstance(case.compiled.subject, PairSubject):
        yield case.against(one, "spec.scope.pairs is about two clients: write Two, or Multiple where more take part")
    elif isinstance(case.compiled.subject, FleetSubject):
        yield case.against(one, "spec.scope.fleet is about all members together: write Two or Multiple")


def _one_and_external(case: Case) -> Iterator[RuleProblem]:
    external = EventDetectionEntity.EXTERNAL
    if case.only(NumberOfParticipants.ONE) and case.only(external):
        yield case.against(
            external,
            f"an external entity that detects the event is a second participant, but numberOfParticipants is "
            f"{NumberOfParticipants.ONE.explained()}: correct one of them",
        )


def _records_itself(case: Case) -> Iterator[RuleProblem]:
    actions = case.rule.spec.actions
    if case.only(ActingEntity.EXTERNAL) and actions and all(each.record or each.database for each in actions):
        fields = ", ".join(f"spec.actions[{index}].{each.field}" for index, each in enumerate(actions))
        yield case.against(
            ActingEntity.EXTERNAL, f"the detector itself carries out {fields}: write EventDetectionEntity"
        )


def _observed(case: Case) -> Iterator[RuleProblem]:
    given = case.given(ObservationPeriod)
    observed = observation(case.rule, case.others)
    fits = {
        ObservationPeriod.IMMEDIATE: observed.ns < _COUPLE_OF_SECONDS,
        ObservationPeriod.SHORT_TERM: observed.ns < _HOUR and (observed.ns > 0 or observed.any_time),
        ObservationPeriod.LONG_TERM: observed.ns >= _HOUR or observed.any_time,
    }
    fitting = [value for value, fit in fits.items() if fit]
    if given and not set(given) & set(fitting):
        remedy = " or ".join(value.value for value in fitting)
        for value in given:
            yield case.against(value, f"{looks_back(observed)}: write {remedy}")


def _late(case: Case) -> Iterator[RuleProblem]:
    every = case.compiled.every_ns or 0
    waits = [_delay_ns(action) for action in case.rule.spec.actions]
    wait = min(waits, default=0)
    delay, given = every + wait, case.given(TimeSensitivity)
    why = f"it is evaluated every {span(every)} (spec.evaluation.every)" if every >= wait else ""
    if wait:
        first = f"spec.actions[{waits.index(wait)}].notify.grouping.wait: {span(wait)}"
        why = " and ".join(each for each in (why, first) if each)
    if case.only(TimeSensitivity.IMMEDIATE) and delay >= _COUPLE_OF_SECONDS:
        yield case.against(TimeSensitivity.IMMEDIATE, f"{why}: shorten it, or write ShortTerm or LongTerm")
    elif case.only(TimeSensitivity.IMMEDIATE, TimeSensitivity.SHORT_TERM) and delay >= _HOUR:
        for value in given:
            yield case.against(value, f"{why}: shorten it, or write LongTerm")


def _always(case: Case) -> Iterator[RuleProblem]:
    if not case.only(Incidence.RARE, Incidence.UNEXPECTED) or case.compiled.when.names:
        return
    if case.compiled.when.evaluate_or_unknown({}) is True:
        for value in case.given(Incidence):
            yield case.against(value, f"spec.when: {case.rule.spec.when} is always true: write Frequent")


def _algorithm(case: Case) -> Iterator[RuleProblem]:
    models, plugins = _learnt(case.rule, case.others, frozenset())
    if case.only(DetectionAlgorithm.RULE_BASED) and models:
        yield case.against(DetectionAlgorithm.RULE_BASED, f"{models[0]} is a learnt model: add LearningBased")
    if case.only(DetectionAlgorithm.LEARNING_BASED) and not models and not plugins:
        yield case.against(
            DetectionAlgorithm.LEARNING_BASED,
            "the conditions use no signal of a model or plugin: write RuleBased, or both if the rule's input comes "
            "from a learnt algorithm",
        )


def _learnt(rule: EventRule, others: Mapping[str, EventRule], above: frozenset[str]) -> tuple[list[str], bool]:
    """The fields of the deciding models, including those of the rules that it names; and whether a plugin decides."""
    models, plugins = [], False
    for index, signal in detecting(rule):
        plugins = plugins or signal.plugin is not None
        if signal.model is not None:
            models.append(f"spec.signals[{index}].model")
        elif signal.rule_name is not None and signal.rule_name in others and signal.rule_name not in above:
            further, any_plugin = _learnt(others[signal.rule_name], others, above | {rule.name})
            models += [f"{each} of the rule {signal.rule_name}" for each in further]
            plugins = plugins or any_plugin
    return models, plugins


# Which types an action of a rule can have. Some follow from the kind of action: `record` records. Others depend on the
# receiver: a message to software may reconfigure it, and an application that is launched may do anything.

_ANY = frozenset(TypeOfAction)
_NOT_RECORDING = _ANY - {TypeOfAction.DATA_COLLECTION}


class _Types(NamedTuple):
    """The types of action that an action can have."""

    needed: frozenset[TypeOfAction]
    """One of these must be in the classification; empty: none is required."""
    possible: frozenset[TypeOfAction]
    """The types that the action can account for."""
    does: str
    """The effect of the action, for a warning."""


_LAUNCHES = _Types(frozenset({TypeOfAction.DEPLOYMENT}), _ANY, "launches software")
_CONFIGURES = _Types(
    frozenset({TypeOfAction.RECONFIGURATION}),
    _ANY - {TypeOfAction.DEPLOYMENT},
    "reconfigures running applications, and starts none",
)
_SUSPENDS = _Types(
    frozenset({TypeOfAction.RECONFIGURATION, TypeOfAction.OTHER}),
    frozenset({TypeOfAction.RECONFIGURATION, TypeOfAction.OTHER}),
    "stops running applications",
)
_RECORDS = _Types(frozenset({TypeOfAction.DATA_COLLECTION}), frozenset({TypeOfAction.DATA_COLLECTION}), "records data")
_TRIES_RECORDING = _RECORDS._replace(needed=frozenset())
_CALLS = _Types(frozenset(), _ANY, "calls another system")
_ALERTS = _Types(frozenset({TypeOfAction.NOTIFICATION}), frozenset({TypeOfAction.NOTIFICATION}), "raises an alert")
_NOTIFIES = _Types(_NOT_RECORDING, _ANY, "sends a notification")

_OF_OPERATION = {
    Operation.DEPLOY: _LAUNCHES,
    Operation.RECONFIGURE: _CONFIGURES,
    Operation.SUSPEND: _SUSPENDS,
}


def _types(action: ActionSpec) -> _Types:
    """The types that the action can have."""
    if action.deploy is not None:
        return _OF_OPERATION[action.deploy.operation]
    if action.record is not None:
        return _RECORDS
    if action.database is not None:
        return _TRIES_RECORDING if action.database.dry_run else _RECORDS
    if action.trigger is not None:
        return _RECORDS if action.trigger.detector is not None else _CALLS
    if action.notify is not None:
        return _ALERTS if action.notify.alertmanager is not None else _NOTIFIES
    return _CALLS


def _delay_ns(action: ActionSpec) -> int:
    """The delay before the action has any effect, in nanoseconds."""
    grouping = None if action.notify is None else action.notify.grouping
    return 0 if grouping is None else grouping.wait.ns


def _unnamed_action(case: Case) -> Iterator[RuleProblem]:
    given = set(case.given(TypeOfAction))
    actions = case.rule.spec.actions
    if not given:
        return
    # A notification about recorded data is a report, as in the paper's Table 2.
    report = TypeOfAction.NOTIFICATION in given and any(action.notify is not None for action in actions)
    for index, action in enumerate(actions):
        needed, _, does = _types(action)
        if needed == {TypeOfAction.DATA_COLLECTION} and report:
            continue
        if needed and not needed & given:
            missing = " or ".join(value.explained() for value in TypeOfAction if value in needed)
            yield case.lacks(TypeOfAction, f"spec.actions[{index}].{action.field} {does}: add {missing}")


def _unaccounted_type(case: Case) -> Iterator[RuleProblem]:
    actions = case.rule.spec.actions
    possible = frozenset[CharacteristicValue]().union(*(_types(action).possible for action in actions))
    for value in case.given(TypeOfAction) if actions else ():  # without actions, another system acts on the events
        if value not in possible:
            listed = ", ".join(f"spec.actions[{index}].{each.field}" for index, each in enumerate(actions))
            yield case.against(value, f"no action of the rule is of this type ({listed}): remove it, or add the action")


CONTRADICTIONS = (
    Contradiction(
        "classification-sender",
        TypeOfParticipants,
        "the rule reads a stream of VAM, but VRU is missing; or of SPATEM or MAPEM, but RoadInfrastructure is missing",
        _senders,
    ),
    Contradiction(
        "classification-participants",
        NumberOfParticipants,
        "only One, but the scope is pairs or the fleet",
        _one_of_several,
    ),
    Contradiction(
        "classification-detecting-entity",
        EventDetectionEntity,
        "only External, but numberOfParticipants is One: two entities take part",
        _one_and_external,
    ),
    Contradiction(
        "classification-acting-entity",
        ActingEntity,
        "only External, but all actions are record or database",
        _records_itself,
    ),
    Contradiction(
        "classification-observation-period",
        ObservationPeriod,
        "no value fits the time that the rule looks back (by windows, for, models and the rules that it reads): "
        "Immediate is below 2 s, ShortTerm below 1 h and more than the newest samples, LongTerm is 1 h or more",
        _observed,
    ),
    Contradiction(
        "classification-time-sensitivity",
        TimeSensitivity,
        "only Immediate, but evaluation.every and notify.grouping delay the action by 2 s or more; or no LongTerm, but "
        "they delay it by 1 h or more",
        _late,
    ),
    Contradiction(
        "classification-incidence", Incidence, "Rare or Unexpected, but the condition is always true", _always
    ),
    Contradiction(
        "classification-algorithm",
        DetectionAlgorithm,
        "only RuleBased, but a model decides; or only LearningBased, but no model or plugin decides",
        _algorithm,
    ),
    Contradiction(
        "classification-missing-action-type",
        TypeOfAction,
        "the type of an action is missing: deploy needs Deployment (Reconfigure: Reconfiguration; Suspend: "
        "Reconfiguration or Other), record, database and trigger.detector need DataCollection (but not beside a notify "
        "action with Notification: that is a report), notify.alertmanager needs Notification",
        _unnamed_action,
    ),
    Contradiction(
        "classification-unused-action-type", TypeOfAction, "no action of the rule has this type", _unaccounted_type
    ),
)
"""All contradictions, in the order of the scheme."""
