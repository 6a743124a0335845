"""One valid object of each kind, as a user would write it, and functions that make invalid copies."""

from __future__ import annotations

import copy
from typing import Any

from tests.cluster.api import Object


class Absent:
    """Marks a field to remove."""

    def __repr__(self) -> str:
        return "absent"


ABSENT = Absent()

EVENT_RULE: Object = {
    "apiVersion": "wayside.dev/v1alpha1",
    "kind": "EventRule",
    "metadata": {"name": "lidar-vehicles-close"},
    "spec": {
        "description": "Two vehicles with a lidar see the same scene.",
        "classification": {"overarchingPurpose": ["Safety"], "typeOfAction": ["Deployment", "DataCollection"]},
        "scope": {
            "pairs": {
                "position": {"stream": "pose", "x": "msg.pose.position.x", "y": "msg.pose.position.y"},
                "within": 250,
                "where": '"points" in a.streams && "points" in b.streams',
            }
        },
        "evaluation": {"every": "500ms"},
        "signals": [{"name": "speed", "stream": "odometry", "value": "msg.speed", "over": "5s", "aggregate": "Max"}],
        "when": "distance < 150",
        "until": "distance > 200",
        "for": "2s",
        "cooldown": "30s",
        "actions": [
            {
                "name": "record",
                "deploy": {"templateName": "recorder", "parameters": {"vehicles": "${[a.client, b.client]}"}},
            }
        ],
    },
}

DETECTOR: Object = {
    "apiVersion": "wayside.dev/v1alpha1",
    "kind": "Detector",
    "metadata": {"name": "intersection-a"},
    "spec": {
        "zenoh": {"mode": "client", "connect": ["tcp/zenoh:7447"]},
        "clients": [{"name": "rsu-1", "labels": {"role": "roadside"}}],
        "streams": [
            {
                "name": "pose",
                "key": "vehicles/${client:*}/pose",
                "encoding": "cdr",
                "type": "geometry_msgs/msg/PoseStamped",
                "staleAfter": "2s",
                "buffer": {"duration": "1m30.5s", "bytes": 67108864},
            },
            {"name": "signals", "key": "rsu/signals", "client": "rsu-1", "encoding": "json", "staleAfter": "Never"},
        ],
        "buffer": {"duration": "10s", "bytes": "5e8"},
        "ruleSelector": {"matchLabels": {"site": "intersection-a"}},
    },
}

APPLICATION_TEMPLATE: Object = {
    "apiVersion": "wayside.dev/v1alpha1",
    "kind": "ApplicationTemplate",
    "metadata": {"name": "scene-fusion"},
    "spec": {
        "parameters": {
            "region": {"type": "string", "required": True, "merge": "Same"},
            "sources": {"type": "array", "items": "string", "merge": "Union"},
            "rateHz": {"type": "number", "default": 10, "minimum": 1, "maximum": 50, "merge": "Max"},
        },
        "key": "${parameters.region}",
        "lifecycle": {"linger": "30s"},
        "manifests": [
            {
                "apiVersion": "v1",
                "kind": "ConfigMap",
                "metadata": {"name": "${instance.name}", "labels": {"region": "${parameters.region}"}},
                "data": {"rate": "${parameters.rateHz}"},
            }
        ],
    },
}

APPLICATION_TASK: Object = {
    "apiVersion": "wayside.dev/v1alpha1",
    "kind": "ApplicationTask",
    "metadata": {"name": "lidar-vehicles-close-abcdefghijklmnop"},
    "spec": {
        "templateName": "scene-fusion",
        "priority": 3,
        "parameters": {"region": "north", "sources": ["car1", "car2"], "rateHz": 20},
        "requester": {"detectorName": "intersection-a", "holder": "intersection-a", "subjects": ["car1", "car2"]},
        "event": {
            "id": "0123456789abcdef",
            "rule": "lidar-vehicles-close",
            "action": "record",
            "subject": "car1+car2",
            "onsetTime": "2026-01-02T03:04:05.000000001Z",
            "startTime": "2026-01-02T03:04:07.000000001Z",
            "classification": {"overarchingPurpose": ["Safety"]},
            "values": {"distance": 149.5, "nested": {"list": [1, "two", None]}},
        },
    },
}

APPLICATION_INSTANCE: Object = {
    "apiVersion": "wayside.dev/v1alpha1",
    "kind": "ApplicationInstance",
    "metadata": {"name": "scene-fusion-abcdefgh"},
    "spec": {"templateName": "scene-fusion", "key": "north", "parameters": {"region": "north", "sources": ["car1"]}},
}

VALID: dict[str, Object] = {
    str(each["kind"]): each
    for each in (EVENT_RULE, DETECTOR, APPLICATION_TEMPLATE, APPLICATION_TASK, APPLICATION_INSTANCE)
}


def changed(manifest: Object, changes: dict[str, Any]) -> Object:
    """Return a copy with other values at dotted paths (`spec.streams.0.type`); the value ABSENT removes the field."""
    result = copy.deepcopy(manifest)
    for path, value in changes.items():
        *parents, last = path.split(".")
        node: Any = result
        for step in parents:
            node = node[int(step)] if isinstance(node, list) else node.setdefault(step, {})
        if value is ABSENT:
            del node[last]
        elif isinstance(node, list):
            index = int(last)
            node[index : index + 1] = [value]  # one behind the end appends
        else:
            node[last] = value
    return result
