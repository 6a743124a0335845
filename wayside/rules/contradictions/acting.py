"""Which types of action an action of a rule can be.

Some follow from the kind of action: `record` records. Others depend on the receiver: a message to
software may reconfigure it, and an application that is launched may do anything.
"""

from __future__ import annotations

from typing import NamedTuple

from wayside.api.actions.action import ActionSpec
from wayside.api.actions.notify import NotifyAction
from wayside.api.operation import Operation
from wayside.api.scheme import TypeOfAction

_ANY = frozenset(TypeOfAction)
_NOT_RECORDING = _ANY - {TypeOfAction.DATA_COLLECTION}


class Types(NamedTuple):
    """The types of action that an action can have."""

    needed: frozenset[TypeOfAction]
    """One of these must be in the classification; empty: none is required."""
    possible: frozenset[TypeOfAction]
    """The types that the action can account for."""
    does: str
    """The effect of the action, for a warning."""


_LAUNCHES = Types(frozenset({TypeOfAction.DEPLOYMENT}), _ANY, "launches software")
_CONFIGURES = Types(
    frozenset({TypeOfAction.RECONFIGURATION}),
    _ANY - {TypeOfAction.DEPLOYMENT},
    "reconfigures running applications, and starts none",
)
_SUSPENDS = Types(
    frozenset({TypeOfAction.RECONFIGURATION, TypeOfAction.OTHER}),
    frozenset({TypeOfAction.RECONFIGURATION, TypeOfAction.OTHER}),
    "stops running applications",
)
_RECORDS = Types(frozenset({TypeOfAction.DATA_COLLECTION}), frozenset({TypeOfAction.DATA_COLLECTION}), "records data")
_TRIES_RECORDING = _RECORDS._replace(needed=frozenset())
_CALLS = Types(frozenset(), _ANY, "calls another system")
_ALERTS = Types(frozenset({TypeOfAction.NOTIFICATION}), frozenset({TypeOfAction.NOTIFICATION}), "raises an alert")
_NOTIFIES = Types(_NOT_RECORDING, _ANY, "sends a notification")

_OF_OPERATION = {
    Operation.DEPLOY: _LAUNCHES,
    Operation.RECONFIGURE: _CONFIGURES,
    Operation.SUSPEND: _SUSPENDS,
}


def types(action: ActionSpec) -> Types:
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


def delay_ns(action: ActionSpec) -> int:
    """How long the action waits before it does anything, in nanoseconds."""
    notify: NotifyAction | None = action.notify
    return 0 if notify is None or notify.grouping is None else notify.grouping.wait.ns
