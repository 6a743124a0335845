"""The updates that the API server must reject: immutable fields of each kind, with the messages."""

from __future__ import annotations

from tests.cluster.manifests import ABSENT
from tests.cluster.wrong_objects import Changes

TIME = "2026-01-02T03:05:00Z"

_KEY = "Forbidden: is immutable, and cannot be added or removed"
_TASK = "Forbidden: is immutable; only parameters and endTime can change"
_INSTANCE = "Forbidden: is immutable: delete this instance"

UPDATES: list[tuple[str, Changes, str]] = [
    ("ApplicationTemplate", {"spec.key": "other"}, rf"spec\.key: {_KEY}"),
    ("ApplicationTemplate", {"spec.key": ABSENT}, rf"spec\.key: {_KEY}"),
    ("ApplicationTask", {"spec.templateName": "other"}, rf"spec\.templateName: {_TASK}"),
    ("ApplicationTask", {"spec.operation": "Suspend"}, rf"spec\.operation: {_TASK}"),
    ("ApplicationTask", {"spec.priority": 4}, rf"spec\.priority: {_TASK}"),
    ("ApplicationTask", {"spec.requester.holder": "other"}, rf"spec\.requester: {_TASK}"),
    ("ApplicationTask", {"spec.requester.subjects": ["car3"]}, rf"spec\.requester: {_TASK}"),
    ("ApplicationTask", {"spec.requester": ABSENT}, rf"spec\.requester: {_TASK}"),
    ("ApplicationTask", {"spec.event": ABSENT}, rf"spec\.event: {_TASK}"),
    ("ApplicationTask", {"spec.event.startTime": TIME}, rf"spec\.event: {_TASK}"),
    ("ApplicationTask", {"spec.event.onsetTime": "2026-01-02T03:04:05.000000002Z"}, rf"spec\.event: {_TASK}"),
    ("ApplicationTask", {"spec.event.values": ABSENT}, rf"spec\.event: {_TASK}"),
    ("ApplicationTask", {"spec.event.values.speed": 1}, rf"spec\.event: {_TASK}"),
    ("ApplicationTask", {"spec.event.values.nested": {"a": [1, {"b": 3}]}}, rf"spec\.event: {_TASK}"),
    ("ApplicationTask", {"spec.event.values.other": "x"}, rf"spec\.event: {_TASK}"),
    ("ApplicationTask", {"spec.event.classification": {}}, rf"spec\.event: {_TASK}"),
    ("ApplicationTask", {"spec.event.classification": ABSENT}, rf"spec\.event: {_TASK}"),
    ("ApplicationInstance", {"spec.templateName": "other"}, rf"spec\.templateName: {_INSTANCE}"),
    ("ApplicationInstance", {"spec.key": "south"}, rf"spec\.key: {_INSTANCE}"),
    ("ApplicationInstance", {"spec.key": ABSENT}, rf"spec\.key: {_INSTANCE}"),
]
