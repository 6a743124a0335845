"""The objects that the API server must reject: wrong objects of each kind, with the messages."""

from __future__ import annotations

from typing import Any

from tests.cluster.manifests import ABSENT, EVENT_RULE

Changes = dict[str, Any]

PAIRS = "spec.scope.pairs"
STREAM = "spec.streams.0"
PARAMETER = "spec.parameters.rateHz"

WRONG: list[tuple[str, str, Changes, str]] = [
    # kind, error, the change that causes it, a part of the message
    (
        "EventRule",
        "two scopes",
        {"spec.scope.client": {}},
        r"spec\.scope: .*give exactly one of client, pairs and fleet",
    ),
    ("EventRule", "no scope", {"spec.scope": {}}, r"spec\.scope: .*exactly one of client, pairs and fleet"),
    (
        "EventRule",
        "half a position",
        {f"{PAIRS}.position.y": ABSENT},
        r"spec\.scope\.pairs\.position: .*give x and y \(optionally z\), or latitude and longitude",
    ),
    (
        "EventRule",
        "a position in metres and degrees",
        {f"{PAIRS}.position.latitude": "msg.lat", f"{PAIRS}.position.longitude": "msg.lon"},
        r"spec\.scope\.pairs\.position: .*give x and y",
    ),
    ("EventRule", "a role without where", {f"{PAIRS}.a": {}}, r"spec\.scope\.pairs\.a\.where: Required value"),
    ("EventRule", "no pair at all", {f"{PAIRS}.maxPairs": 0}, r"maxPairs: .*greater than or equal to 1"),
    (
        "EventRule",
        "an element without a name",
        {"spec.each": {"as": "site", "of": [{"x": 1}]}},
        r"spec\.each\.of\[0\]\.name: Required value",
    ),
    (
        "EventRule",
        "two elements of one name",
        {"spec.each": {"as": "site", "of": [{"name": "n"}, {"name": "n", "x": 1}]}},
        r'spec\.each\.of\[1\]: Duplicate value: .*"n"',
    ),
    (
        "EventRule",
        "an element of too many fields",
        {"spec.each": {"as": "site", "of": [{"name": "n", **{f"f{each}": 1 for each in range(64)}}]}},
        r"spec\.each\.of\[0\]: Too many: 65: must have at most 64 items",
    ),
    ("EventRule", "no element", {"spec.each": {"as": "site", "of": []}}, r"spec\.each\.of: .*at least 1 items"),
    ("EventRule", "no condition", {"spec.when": ABSENT}, r"spec\.when: Required value"),
    ("EventRule", "an empty condition", {"spec.when": ""}, r"spec\.when: .*at least 1 chars"),
    ("EventRule", "a number as condition", {"spec.when": True}, r"spec\.when: .*must be of type string"),
    ("EventRule", "a duration without unit", {"spec.for": "2"}, r"spec\.for: .*should match"),
    ("EventRule", "a duration as number", {"spec.cooldown": 30}, r"spec\.cooldown: .*must be of type string"),
    (
        "EventRule",
        "evaluation too often",
        {"spec.evaluation.every": "5ms"},
        r"spec\.evaluation\.every: .*must be 10ms or more",
    ),
    *(
        (
            "EventRule",
            f"evaluation every {zero}",
            {"spec.evaluation.every": zero},
            r"spec\.evaluation\.every: .*must be 10ms or more",
        )
        for zero in ("0ms", "0s", "0m", "0h")
    ),
    (
        "EventRule",
        "a window without length",
        {"spec.signals.0.over": "0s"},
        r"spec\.signals\[0\]\.over: .*give a duration above zero, such as 500ms or 10s",
    ),
    ("EventRule", "an unknown field", {"spec.untl": "distance > 200"}, r'unknown field "spec\.untl"'),
    (
        "EventRule",
        "an unknown aggregate",
        {"spec.signals.0.aggregate": "Maximum"},
        r'spec\.signals\[0\]\.aggregate: Unsupported value: "Maximum": supported values: .*"Max"',
    ),
    (
        "EventRule",
        "an aggregate without its window",
        {"spec.signals.0.over": ABSENT},
        r"spec\.signals\[0\]\.over: Required value: .*needs a window: give over, e\.g\. over: 5s",
    ),
    (
        "EventRule",
        "a signal without value",
        {"spec.signals.0.value": ABSENT},
        r"spec\.signals\[0\]\.value: .*give value, e\.g\. value: msg\.speed",
    ),
    (
        "EventRule",
        "a value that is not looked at",
        {"spec.signals.0.aggregate": "Count"},
        r"except with the aggregates Count, Age and Active, which use no value",
    ),
    (
        "EventRule",
        "two signals of one name",
        {"spec.signals.1": EVENT_RULE["spec"]["signals"][0]},
        r'spec\.signals\[1\]: Duplicate value: .*"speed"',
    ),
    ("EventRule", "a signal's name that is no variable", {"spec.signals.0.name": "my-speed"}, r"signals\[0\]\.name: "),
    ("EventRule", "no distance at all", {f"{PAIRS}.within": 0}, r"spec\.scope\.pairs\.within: .*greater than 0"),
    (
        "EventRule",
        "a classification that the scheme does not know",
        {"spec.classification.overarchingPurpose": ["Fun"]},
        r'spec\.classification\.overarchingPurpose\[0\]: Unsupported value: "Fun": supported values: .*"Safety"',
    ),
    (
        "EventRule",
        "a template's name that is too long",
        {"spec.actions.0.deploy.templateName": "x" * 41},
        r"spec\.actions\[0\]\.deploy\.templateName: Too long: may not be (more|longer) than 40",
    ),
    (
        "EventRule",
        "an action that does nothing",
        {"spec.actions.0.deploy": ABSENT},
        r"spec\.actions\[0\]: Invalid value: .*give exactly one of deploy, record",
    ),
    ("EventRule", "a name that is too long", {"metadata.name": "x" * 64}, r"metadata\.name: .*63"),
    *(
        (kind, "a name with a dot", {"metadata.name": "a.b"}, r"metadata\.name: .*should match '\^\[a-z0-9\]")
        for kind in ("ApplicationInstance", "ApplicationTask", "ApplicationTemplate", "Detector", "EventRule")
    ),
    (
        "Detector",
        "a volume with a reserved name",
        {"spec.mode": "Sidecar", "spec.pod": {"volumes": [{"name": "token", "emptyDir": {}}]}},
        r"spec\.pod\.volumes\[0\]\.name: Forbidden: the names scratch, metrics, token",
    ),
    (
        "Detector",
        "a volume with a long name",
        {"spec.mode": "Sidecar", "spec.pod": {"volumes": [{"name": "v" * 56, "emptyDir": {}}]}},
        r"spec\.pod\.volumes\[0\]\.name: Too long: may not be (more|longer) than 55",
    ),
    ("Detector", "no streams", {"spec.streams": []}, r"spec\.streams: .*at least 1 items"),
    (
        "Detector",
        "accounts of a detector that is no sidecar",
        {"spec.serviceAccountNames": ["vehicle"]},
        r"spec\.serviceAccountNames: Forbidden: serviceAccountNames has no effect without mode Sidecar",
    ),
    (
        "Detector",
        "a sidecar on nodes of its own",
        {"spec.mode": "Sidecar", "spec.pod": {"nodeSelector": {"a": "b"}}},
        r"spec\.pod: Forbidden: .*have no effect with mode Sidecar",
    ),
    (
        "Detector",
        "a cdr stream without its type",
        {f"{STREAM}.type": ABSENT},
        r"spec\.streams\[0\]\.type: .*type is required with encoding cdr, optional with uper",
    ),
    (
        "Detector",
        "a json stream with a type",
        {f"{STREAM}.encoding": "json"},
        r"spec\.streams\[0\]\.type: .*type is required with encoding cdr",
    ),
    (
        "Detector",
        "a type that is none",
        {f"{STREAM}.type": "PoseStamped"},
        r"spec\.streams\[0\]\.type: .*PoseStamped.*should match",
    ),
    (
        "Detector",
        "a key without its client",
        {f"{STREAM}.key": "vehicles/pose"},
        r"spec\.streams\[0\]\.client: .*either key must capture the client",
    ),
    (
        "Detector",
        "two clients of one stream",
        {f"{STREAM}.client": "ego"},
        r"spec\.streams\[0\]\.client: .*either key must capture the client",
    ),
    (
        "Detector",
        "an unknown encoding",
        {f"{STREAM}.encoding": "protobuf"},
        r'spec\.streams\[0\]\.encoding: Unsupported value: "protobuf": supported values: "cdr", "json"',
    ),
    (
        "Detector",
        "the layout of ROS 2 nodes for JSON",
        {f"{STREAM}.layout": "RmwZenoh", f"{STREAM}.encoding": "json", f"{STREAM}.type": None},
        r"spec\.streams\[0\]\.layout: .*layout RmwZenoh needs ROS 2 messages: encoding must be cdr or raw",
    ),
    (
        "Detector",
        "a domain without the layout that has one",
        {f"{STREAM}.domain": 7},
        r"spec\.streams\[0\]\.domain: Forbidden: domain is valid only with layout RmwZenoh: remove it",
    ),
    (
        "Detector",
        "a message type without its folder",
        {"spec.messages": [{"name": "my_msgs/Track", "definition": "int32 x"}]},
        r"spec\.messages\[0\]\.name: .*should match",
    ),
    ("Detector", "a size without number", {"spec.buffer.bytes": "much"}, r"spec\.buffer\.bytes: .*should match"),
    ("Detector", "a buffer without room", {"spec.buffer.bytes": "0Mi"}, r"spec\.buffer\.bytes: .*should match"),
    ("Detector", "a buffer without time", {"spec.buffer.duration": "0s"}, r"spec\.buffer\.duration: .*above zero"),
    ("Detector", "a stream without time", {f"{STREAM}.buffer.duration": "0s"}, r"streams\[0\]\.buffer\.duration: "),
    ("Detector", "a client lost at once", {"spec.clientTimeout": "0s"}, r"spec\.clientTimeout: .*above zero"),
    ("Detector", "data stale at once", {f"{STREAM}.staleAfter": "00s"}, r"spec\.streams\[0\]\.staleAfter: "),
    (
        "Detector",
        "a buffer of no bytes",
        {"spec.buffer.bytes": 0},
        r"spec\.buffer\.bytes: .*greater than or equal to 1",
    ),
    (
        "Detector",
        "a part of a byte",
        {"spec.buffer.bytes": 0.5},
        r"spec\.buffer\.bytes: .*must be of type integer,string",
    ),
    ("Detector", "a client's name with a slash", {"spec.clients.0.name": "a/b"}, r"spec\.clients\[0\]\.name: "),
    (
        "Detector",
        "two streams of one name",
        {"spec.streams.1.name": "pose"},
        r'spec\.streams\[1\]: Duplicate value: .*"pose"',
    ),
    ("Detector", "an endpoint that is none", {"spec.zenoh.connect": ["zenoh:7447"]}, r"spec\.zenoh\.connect\[0\]: "),
    (
        "Detector",
        "TLS given twice",
        {"spec.zenoh.tls": {"ca": "ca.crt"}, "spec.zenoh.tlsSecretName": "zenoh"},
        r"spec\.zenoh\.tlsSecretName: Forbidden: give tls or tlsSecretName, not both",
    ),
    (
        "Detector",
        "TLS without a certificate",
        {"spec.zenoh.listen": ["tls/0.0.0.0:7447"]},
        r"spec\.zenoh\.listen: .*needs a certificate: set tls\.certificate",
    ),
    (
        "Detector",
        "half a certificate",
        {"spec.zenoh.tls": {"certificate": "tls.crt"}},
        r"spec\.zenoh\.tls\.certificate: .*give both certificate and key, or neither",
    ),
    (
        "Detector",
        "a username without its password",
        {"spec.zenoh.credentials": {"username": "detector"}},
        r"spec\.zenoh\.credentials: .*give exactly one of passwordVariable and passwordFile",
    ),
    (
        "Detector",
        "tokens without their client",
        {"spec.zenoh.liveliness": "alive/*"},
        r"spec\.zenoh\.liveliness: .*liveliness does not capture the client",
    ),
    ("Detector", "a source without its plugin", {"spec.sources": [{"name": "a"}]}, r"spec\.sources\[0\]\.plugin: Req"),
    (
        "Detector",
        "a selector without its values",
        {"spec.ruleSelector.matchExpressions": [{"key": "site", "operator": "In"}]},
        r"spec\.ruleSelector\.matchExpressions\[0\].*: .*operators In and NotIn need values",
    ),
    ("Detector", "an unknown clock", {"spec.clock": "Sun"}, r'spec\.clock: Unsupported value: "Sun".*"Wall", "Data"'),
    ("ApplicationTemplate", "no manifests", {"spec.manifests": []}, r"spec\.manifests: .*at least 1 items"),
    (
        "ApplicationTemplate",
        "a name that is too long for its instances'",
        {"metadata.name": "x" * 41},
        r"metadata\.name: .*40",
    ),
    (
        "ApplicationTemplate",
        "an unknown type",
        {f"{PARAMETER}.type": "float"},
        r'spec\.parameters\[?.?rateHz\]?\.type: Unsupported value: "float": supported values: .*"number"',
    ),
    (
        "ApplicationTemplate",
        "a union of numbers",
        {f"{PARAMETER}.merge": "Union"},
        r"spec\.parameters\[?.?rateHz\]?\.merge: .*merge Union and Intersection need type array",
    ),
    (
        "ApplicationTemplate",
        "a maximum of strings",
        {"spec.parameters.region.merge": "Max"},
        r"merge Max, Min and Sum need type number or integer",
    ),
    (
        "ApplicationTemplate",
        "bounds of a string",
        {"spec.parameters.region.minimum": 1},
        r"minimum and maximum need type number or integer",
    ),
    (
        "ApplicationTemplate",
        "a baseline beside a key",
        {"spec.baseline": {}},
        r"baseline is valid only without key",
    ),
    (
        "ApplicationTask",
        "an unknown operation",
        {"spec.operation": "Stop"},
        r'spec\.operation: .*"Deploy", "Reconfigure"',
    ),
    ("ApplicationTemplate", "any of texts", {"spec.parameters.region.merge": "Any"}, r"All and Any need type boolean"),
    (
        "ApplicationTemplate",
        "bounds that exclude all",
        {f"{PARAMETER}.maximum": 0},
        r"minimum must not be above maximum",
    ),
    ("ApplicationTemplate", "a pattern of numbers", {f"{PARAMETER}.pattern": "^a"}, r"pattern needs type string"),
    ("ApplicationTemplate", "items of a number", {f"{PARAMETER}.items": "string"}, r"items needs type array"),
    (
        "ApplicationTemplate",
        "a lifecycle without unit",
        {"spec.lifecycle.linger": "30"},
        r"spec\.lifecycle\.linger: .*should match",
    ),
    ("ApplicationTask", "no template", {"spec.templateName": ABSENT}, r"spec\.templateName: Required value"),
    (
        "ApplicationTask",
        "a template's name that is none",
        {"spec.templateName": "Scene Fusion"},
        r"spec\.templateName: .*should match",
    ),
    (
        "ApplicationTask",
        "a start that is no time",
        {"spec.event.startTime": "yesterday"},
        r"spec\.event\.startTime: .*should match",
    ),
    (
        "ApplicationTask",
        "an end on a day that does not exist",
        {"spec.endTime": "2026-02-30T25:00:00Z"},
        r"spec\.endTime: .*must be of type date-time",
    ),
    ("ApplicationTask", "a priority beyond bounds", {"spec.priority": 2_000_000}, r"spec\.priority: .*1e\+06|1000000"),
    (
        "ApplicationTask",
        "a parameter of lists in lists",
        {"spec.parameters.sources": [[[[[["car1"]]]]]]},
        r"spec\.parameters\.sources\[0\]\[0\]\[0\]\[0\]\[0\]: Too many: 1: must have at most 0 items",
    ),
    (
        "ApplicationTask",
        "a value of maps in lists",
        {"spec.event.values.nested": [{"a": [{"b": [{"c": 1}]}]}]},
        r"spec\.event\.values\.nested\[0\]\.a\[0\]\.b\[0\]: Too many: 1: must have at most 0 items",
    ),
    (
        "ApplicationTask",
        "a long text deep in a value",
        {"spec.event.values.nested": [["x" * 70_000]]},
        r"spec\.event\.values\.nested\[0\]\[0\]: Too long: may not be (more|longer) than 65536",
    ),
    (
        "ApplicationInstance",
        "a parameter of too many items",
        {"spec.parameters.sources": [{"a": [0] * 40_000}]},
        r"spec\.parameters\.sources\[0\]\.a: Too many: 40000: must have at most 32768 items",
    ),
    ("ApplicationTask", "parameters as a list", {"spec.parameters": []}, r"spec\.parameters: .*must be of type object"),
    ("ApplicationTask", "an unknown field", {"spec.templat": "x"}, r'unknown field "spec\.templat"'),
    ("ApplicationInstance", "no template", {"spec.templateName": ABSENT}, r"spec\.templateName: Required value"),
    ("ApplicationInstance", "a key as number", {"spec.key": 3}, r"spec\.key: .*must be of type string"),
    ("ApplicationInstance", "a name that is too long", {"metadata.name": "x" * 64}, r"metadata\.name: .*63"),
]
