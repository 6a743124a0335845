"""The API server accepts Wayside's CRDs, and refuses wrong objects with messages that help."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.cluster.api import Api, ApiError
from tests.cluster.controlplane import ControlPlane
from tests.cluster.manifests import (
    ABSENT,
    APPLICATION_INSTANCE,
    APPLICATION_TASK,
    APPLICATION_TEMPLATE,
    DETECTOR,
    EVENT_RULE,
    VALID,
    changed,
)

Changes = dict[str, Any]

PAIRS = "spec.scope.pairs"
STREAM = "spec.streams.0"
PARAMETER = "spec.parameters.rateHz"

WRONG: list[tuple[str, str, Changes, str]] = [
    # kind, what is wrong, how it becomes so, what the message says
    (
        "EventRule",
        "two scopes",
        {"spec.scope.client": {}},
        r"spec\.scope: .*exactly one of client and pairs must be given",
    ),
    ("EventRule", "no scope", {"spec.scope": {}}, r"spec\.scope: .*exactly one of client and pairs must be given"),
    ("EventRule", "no condition", {"spec.when": ABSENT}, r"spec\.when: Required value"),
    ("EventRule", "an empty condition", {"spec.when": ""}, r"spec\.when: .*at least 1 chars"),
    ("EventRule", "a number as condition", {"spec.when": True}, r"spec\.when: .*must be of type string"),
    ("EventRule", "a duration without unit", {"spec.for": "2"}, r"spec\.for: .*\(ms\|s\|m\|h\)"),
    ("EventRule", "a duration as number", {"spec.cooldown": 30}, r"spec\.cooldown: .*must be of type string"),
    ("EventRule", "evaluation too often", {"spec.evaluation.every": "5ms"}, r"every: give 10ms or more"),
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
        r"spec\.signals\[0\]: .*need a window: give over, e\.g\. over: 5s",
    ),
    (
        "EventRule",
        "a signal without value",
        {"spec.signals.0.value": ABSENT},
        r"spec\.signals\[0\]: .*give value, e\.g\. value: msg\.speed",
    ),
    (
        "EventRule",
        "a value that is not looked at",
        {"spec.signals.0.aggregate": "Count"},
        r"none for the aggregates Count and Age, which look at no value",
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
        {"spec.actions.0.deploy.template": "x" * 41},
        r"spec\.actions\[0\]\.deploy\.template: Too long: may not be more than 40 ",
    ),
    (
        "EventRule",
        "an action that does nothing",
        {"spec.actions.0.deploy": ABSENT},
        r"spec\.actions\[0\]\.deploy: Required value",
    ),
    ("EventRule", "a name that is too long", {"metadata.name": "x" * 64}, r"metadata\.name: .*63"),
    ("Detector", "no streams", {"spec.streams": []}, r"spec\.streams: .*at least 1 items"),
    (
        "Detector",
        "a cdr stream without its type",
        {f"{STREAM}.type": ABSENT},
        r"spec\.streams\[0\]: .*type is for cdr streams, and they need it, e\.g\. geometry_msgs",
    ),
    (
        "Detector",
        "a json stream with a type",
        {f"{STREAM}.encoding": "json"},
        r"spec\.streams\[0\]: .*type is for cdr streams",
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
        r"spec\.streams\[0\]: .*key must capture the client, as \$\{client:\*\}, or client must name it",
    ),
    (
        "Detector",
        "two clients of one stream",
        {f"{STREAM}.client": "ego"},
        r"spec\.streams\[0\]: .*key must capture the client.*not both",
    ),
    (
        "Detector",
        "an unknown encoding",
        {f"{STREAM}.encoding": "protobuf"},
        r'spec\.streams\[0\]\.encoding: Unsupported value: "protobuf": supported values: "cdr", "json"',
    ),
    ("Detector", "a size without number", {"spec.buffer.bytes": "much"}, r"spec\.buffer\.bytes: .*should match"),
    ("Detector", "a size as number", {"spec.buffer.bytes": 512}, r"spec\.buffer\.bytes: .*must be of type string"),
    ("Detector", "a client's name with a slash", {"spec.clients.0.name": "a/b"}, r"spec\.clients\[0\]\.name: "),
    (
        "Detector",
        "two streams of one name",
        {"spec.streams.1.name": "pose"},
        r'spec\.streams\[1\]: Duplicate value: .*"pose"',
    ),
    ("Detector", "an endpoint that is none", {"spec.zenoh.connect": ["zenoh:7447"]}, r"spec\.zenoh\.connect\[0\]: "),
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
        r"spec\.parameters\[?.?rateHz\]?: .*merge Union needs type array",
    ),
    (
        "ApplicationTemplate",
        "a maximum of strings",
        {"spec.parameters.region.merge": "Max"},
        r"merge Max and Min need type number or integer",
    ),
    (
        "ApplicationTemplate",
        "bounds of a string",
        {"spec.parameters.region.minimum": 1},
        r"minimum and maximum need type number or integer",
    ),
    ("ApplicationTemplate", "items of a number", {f"{PARAMETER}.items": "string"}, r"items needs type array"),
    (
        "ApplicationTemplate",
        "a lifecycle without unit",
        {"spec.lifecycle.linger": "30"},
        r"spec\.lifecycle\.linger: .*should match",
    ),
    ("ApplicationTask", "no template", {"spec.template": ABSENT}, r"spec\.template: Required value"),
    (
        "ApplicationTask",
        "a template's name that is none",
        {"spec.template": "Scene Fusion"},
        r"spec\.template: .*should match",
    ),
    (
        "ApplicationTask",
        "a start that is no time",
        {"spec.event.startTime": "yesterday"},
        r"spec\.event\.startTime: .*should match",
    ),
    ("ApplicationTask", "a priority beyond bounds", {"spec.priority": 2_000_000}, r"spec\.priority: .*1e\+06|1000000"),
    ("ApplicationTask", "parameters as a list", {"spec.parameters": []}, r"spec\.parameters: .*must be of type object"),
    ("ApplicationTask", "an unknown field", {"spec.templat": "x"}, r'unknown field "spec\.templat"'),
    ("ApplicationInstance", "no template", {"spec.template": ABSENT}, r"spec\.template: Required value"),
    ("ApplicationInstance", "a key as number", {"spec.key": 3}, r"spec\.key: .*must be of type string"),
    ("ApplicationInstance", "a name that is too long", {"metadata.name": "x" * 64}, r"metadata\.name: .*63"),
]

CHANGED: dict[str, Changes] = {
    "EventRule": {"spec.when": "true"},
    "Detector": {"spec.clock": "Data"},
    "ApplicationTemplate": {"spec.description": "another"},
    "ApplicationTask": {"spec.parameters": {}},
    "ApplicationInstance": {"spec.parameters": {}},
}

TIME = "2026-01-02T03:05:00Z"

UPDATES: list[tuple[str, Changes, str]] = [
    ("ApplicationTemplate", {"spec.key": "other"}, "spec.key is immutable, also in being there"),
    ("ApplicationTemplate", {"spec.key": ABSENT}, "spec.key is immutable, also in being there"),
    ("ApplicationTask", {"spec.template": "other"}, "only spec.parameters may change, and spec.endTime be set"),
    ("ApplicationTask", {"spec.priority": 4}, "only spec.parameters may change, and spec.endTime be set"),
    ("ApplicationTask", {"spec.requester.holder": "other"}, "only spec.parameters may change"),
    ("ApplicationTask", {"spec.requester.subjects": ["car3"]}, "only spec.parameters may change"),
    ("ApplicationTask", {"spec.requester": ABSENT}, "only spec.parameters may change"),
    ("ApplicationTask", {"spec.event": ABSENT}, "only spec.parameters may change"),
    ("ApplicationTask", {"spec.event.startTime": TIME}, "only spec.parameters may change"),
    ("ApplicationInstance", {"spec.template": "other"}, "spec.template and spec.key are immutable"),
    ("ApplicationInstance", {"spec.key": "south"}, "spec.template and spec.key are immutable"),
    ("ApplicationInstance", {"spec.key": ABSENT}, "spec.template and spec.key are immutable"),
]


def test_the_api_server_accepts_every_crd(control_plane: ControlPlane) -> None:
    assert {file: str(error) for file, error in control_plane.refused_crds.items()} == {}


@pytest.mark.parametrize("kind", VALID)
def test_a_valid_object_is_stored_as_it_was_written(kind: str, api: Api) -> None:
    written = VALID[kind]
    stored = api.create(written)
    assert _covers(stored["spec"], written["spec"]), stored["spec"]


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [pytest.param(kind, changes, message, id=f"{kind}: {what}") for kind, what, changes, message in WRONG],
)
def test_a_wrong_object_is_refused_with_a_message_that_helps(
    kind: str, changes: Changes, message: str, api: Api
) -> None:
    with pytest.raises(ApiError, match=rf"(?s){message}") as caught:
        api.create(changed(VALID[kind], changes))
    assert caught.value.code in (400, 422)


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        pytest.param(kind, changes, message, id=f"{kind}: {next(iter(changes))} {next(iter(changes.values()))!r:.9}")
        for kind, changes, message in UPDATES
    ],
)
def test_what_is_immutable_cannot_be_changed(kind: str, changes: Changes, message: str, api: Api) -> None:
    stored = api.create(VALID[kind])
    with pytest.raises(ApiError, match=message):
        api.replace(changed(stored, changes))


class TestApplicationTask:
    def test_its_parameters_may_change(self, api: Api) -> None:
        stored = api.create(APPLICATION_TASK)
        replaced = api.replace(changed(stored, {"spec.parameters.rateHz": 30, "spec.parameters.sources": ["car3"]}))
        assert replaced["spec"]["parameters"] == {"region": "north", "sources": ["car3"], "rateHz": 30}

    def test_its_end_is_set_once(self, api: Api) -> None:
        stored = api.create(APPLICATION_TASK)
        ended = api.replace(changed(stored, {"spec.endTime": TIME}))
        for value in ("2026-01-02T04:00:00Z", ABSENT):
            with pytest.raises(ApiError, match=r"spec\.endTime is set once: a demand that ended does not come back"):
                api.replace(changed(ended, {"spec.endTime": value}))

    def test_a_persons_task_needs_only_a_template(self, api: Api) -> None:
        stored = api.create(changed(APPLICATION_TASK, {"spec": {"template": "scene-fusion"}}))
        assert stored["spec"]["priority"] == 0

    @pytest.mark.parametrize(
        ("selector", "found"),
        [
            ("spec.template=scene-fusion", ["one", "two"]),
            ("spec.template=other", ["three"]),
            ("spec.requester.detector=intersection-a", ["one"]),
            ("status.instance=scene-fusion-abcdefgh", ["two"]),
            ("spec.template=scene-fusion,status.instance!=scene-fusion-abcdefgh", ["one"]),
        ],
    )
    def test_its_selectable_fields_work_in_a_selector(self, selector: str, found: list[str], api: Api) -> None:
        api.create(changed(APPLICATION_TASK, {"metadata.name": "one"}))
        api.create(changed(APPLICATION_TASK, {"metadata.name": "two", "spec.requester.detector": "other"}))
        api.create(changed(APPLICATION_TASK, {"metadata.name": "three", "spec": {"template": "other"}}))
        status = {"status": {"instance": "scene-fusion-abcdefgh"}}
        api.patch("ApplicationTask", "two", status, subresource="status")
        assert sorted(each["metadata"]["name"] for each in api.list("ApplicationTask", fields=selector)) == sorted(
            found
        )


class TestStatus:
    @pytest.mark.parametrize("kind", VALID)
    def test_it_is_written_apart_from_the_spec(self, kind: str, api: Api) -> None:
        condition = {
            "type": "Accepted",
            "status": "True",
            "reason": "Valid",
            "message": "",
            "observedGeneration": 1,
            "lastTransitionTime": TIME,
        }
        stored = api.create(VALID[kind] | {"status": {"conditions": [condition]}})
        name = stored["metadata"]["name"]
        assert "conditions" not in stored.get("status", {})

        patched = api.patch(kind, name, {"status": {"conditions": [condition]}}, subresource="status")
        assert patched["status"]["conditions"] == [condition]
        assert patched["metadata"]["generation"] == 1

        ignored = api.replace(changed(patched, CHANGED[kind]), subresource="status")
        assert ignored["spec"] == stored["spec"]

    def test_a_condition_with_a_status_of_its_own_is_refused(self, api: Api) -> None:
        api.create(DETECTOR)
        condition = {"type": "Accepted", "status": "Yes", "reason": "R", "lastTransitionTime": TIME}
        with pytest.raises(ApiError, match=r'conditions\[0\]\.status: Unsupported value: "Yes"'):
            api.patch("Detector", "intersection-a", {"status": {"conditions": [condition]}}, subresource="status")


@pytest.mark.parametrize("kind", VALID)
def test_every_field_has_a_description(kind: str, control_plane: ControlPlane) -> None:
    crd = control_plane.api().get("CustomResourceDefinition", f"{kind.lower()}s.wayside.dev")
    schema = crd["spec"]["versions"][0]["schema"]["openAPIV3Schema"]
    fields = {path: field for part in ("spec", "status") for path, field in _fields(part, schema["properties"][part])}
    assert len(fields) > 10
    assert [path for path, field in fields.items() if not field.get("description")] == []


class TestServerSideApply:
    def test_two_managers_share_a_rules_signals_by_name(self, api: Api) -> None:
        api.apply(EVENT_RULE, field_manager="one")
        other = {"name": "braking", "stream": "odometry", "value": "msg.acceleration"}
        api.apply(changed(EVENT_RULE, {"spec.signals": [other]}), field_manager="two")
        stored = api.get("EventRule", EVENT_RULE["metadata"]["name"])
        assert [signal["name"] for signal in stored["spec"]["signals"]] == ["speed", "braking"]

    def test_applying_the_same_again_changes_nothing(self, api: Api) -> None:
        for manifest in VALID.values():
            first = api.apply(manifest)
            assert api.apply(manifest)["metadata"]["resourceVersion"] == first["metadata"]["resourceVersion"]


class TestKubectl:
    @pytest.mark.parametrize(
        ("path", "teaches"),
        [
            ("eventrule", "An event to detect in the data of vehicles and stations"),
            ("eventrule.spec.scope", "Whom the rule is about"),
            ("eventrule.spec.scope.pairs.within", "Metres."),
            ("eventrule.spec.when", "an episode starts when it holds"),
            ("detector.spec.streams.key", "captures the client's name"),
            ("applicationtemplate.spec.parameters.merge", "Union: all items"),
            ("applicationtask.spec.endTime", "Absent while the demand holds"),
            ("applicationinstance.status.releaseTime", "the end of its linger"),
        ],
    )
    def test_explain_teaches(self, path: str, teaches: str, control_plane: ControlPlane) -> None:
        explained = " ".join(control_plane.kubectl("explain", path).split())
        assert teaches in explained

    @pytest.mark.parametrize(
        ("short", "manifest", "columns"),
        [
            ("er", EVENT_RULE, ["NAME", "ENABLED", "ACCEPTED", "DETECTORS", "WHEN", "AGE"]),
            ("det", DETECTOR, ["NAME", "CLOCK", "RULES", "ACCEPTED", "AGE"]),
            ("apptpl", APPLICATION_TEMPLATE, ["NAME", "KEY", "INSTANCES", "ACCEPTED", "AGE"]),
            (
                "apptask",
                APPLICATION_TASK,
                ["NAME", "TEMPLATE", "RULE", "SUBJECT", "INSTANCE", "PHASE", "AGE"],
            ),
            ("appinst", APPLICATION_INSTANCE, ["NAME", "TEMPLATE", "KEY", "DEMANDS", "READY", "PHASE", "AGE"]),
        ],
    )
    def test_get_by_short_name_prints_the_columns(
        self, short: str, manifest: dict[str, Any], columns: list[str], control_plane: ControlPlane, api: Api
    ) -> None:
        api.create(manifest)
        header, row = control_plane.kubectl("get", short, "--namespace", api.namespace).splitlines()
        assert header.split() == columns
        assert row.startswith(manifest["metadata"]["name"])

    def test_the_category_lists_all_kinds(self, control_plane: ControlPlane, api: Api) -> None:
        for manifest in VALID.values():
            api.create(manifest)
        listed = control_plane.kubectl("get", "wayside", "--namespace", api.namespace, "--output", "name").split()
        assert sorted(name.split(".")[0] for name in listed) == sorted(kind.lower() for kind in VALID)


def _covers(stored: Any, written: Any) -> bool:
    """Whether all that was written is there; defaults may have joined it."""
    if isinstance(written, dict):
        return isinstance(stored, dict) and all(
            key in stored and _covers(stored[key], value) for key, value in written.items()
        )
    if isinstance(written, list):
        return len(stored) == len(written) and all(map(_covers, stored, written))
    return bool(stored == written)


def _fields(path: str, schema: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Walk all fields of a schema, with their paths."""
    yield path, schema
    for name, child in schema.get("properties", {}).items():
        yield from _fields(f"{path}.{name}", child)
    for inner in (schema.get("items"), schema.get("additionalProperties")):
        for name, child in (inner or {}).get("properties", {}).items():
            yield from _fields(f"{path}[].{name}", child)
