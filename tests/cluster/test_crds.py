"""The API server accepts Wayside's CRDs, and refuses wrong objects with messages that help."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.cluster.api import Api, ApiError
from tests.cluster.controlplane import ControlPlane
from tests.cluster.crds import CRDS
from tests.cluster.forbidden_updates import TIME, UPDATES
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
from tests.cluster.wrong_objects import WRONG, Changes
from wayside.api import KINDS, EventRule

EXAMPLES = [
    file
    for file in sorted((Path(__file__).parents[2] / "examples").glob("*/*.yaml"))
    if "wayside.dev/" in file.read_text()
]

CHANGED: dict[str, Changes] = {
    "EventRule": {"spec.when": "true"},
    "Detector": {"spec.clock": "Data"},
    "ApplicationTemplate": {"spec.description": "another"},
    "ApplicationTask": {"spec.parameters": {}},
    "ApplicationInstance": {"spec.parameters": {}},
}


def test_the_api_server_accepts_every_crd(control_plane: ControlPlane) -> None:
    assert {file: str(error) for file, error in control_plane.refused_crds.items()} == {}


@pytest.mark.parametrize("kind", VALID)
def test_a_valid_object_is_stored_unchanged(kind: str, api: Api) -> None:
    written = VALID[kind]
    stored = api.create(written)
    assert _covers(stored["spec"], written["spec"]), stored["spec"]


SCOPES: dict[str, dict[str, Any]] = {
    "roles on the Earth": {
        "pairs": {
            "position": {"stream": "gnss", "latitude": "msg.lat", "longitude": "msg.lon"},
            "within": 250.5,
            "a": {"where": "labels.role == 'tram'"},
            "b": {"where": "labels.role == 'car'"},
            "maxPairs": 500,
        }
    },
    "the fleet": {"fleet": {"members": "speed > 0"}},
    "each client": {"client": {"where": "'pose' in streams"}},
}


@pytest.mark.parametrize("scope", SCOPES)
def test_every_scope_and_the_fields_of_elements_are_stored_unchanged(scope: str, api: Api) -> None:
    each = {"as": "site", "of": [{"name": "north", "x": 1.5, "node": "rsu-1", "area": [[0, 0], [1, 1]], "on": True}]}
    rule = changed(EVENT_RULE, {"spec.scope": SCOPES[scope], "spec.each": each})
    stored = api.create(rule)
    for field in ("scope", "each"):
        assert _covers(stored["spec"][field], rule["spec"][field])
    EventRule.model_validate(stored)


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: f"{file.parent.name}/{file.name}")
def test_every_example_is_accepted(file: Path, api: Api) -> None:
    manifests = [each for each in yaml.safe_load_all(file.read_text()) if each and "wayside.dev" in each["apiVersion"]]
    assert manifests
    for manifest in manifests:
        manifest["metadata"].pop("namespace", None)
        api.apply(manifest)


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [pytest.param(kind, changes, message, id=f"{kind}: {what}") for kind, what, changes, message in WRONG],
)
def test_an_invalid_object_is_rejected_with_a_helpful_message(
    kind: str, changes: Changes, message: str, control_plane: ControlPlane
) -> None:
    with pytest.raises(ApiError, match=rf"(?s){message}") as caught:
        control_plane.api("default").create(changed(VALID[kind], changes))  # rejected, so all can share a namespace
    assert caught.value.code in (400, 422)


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        pytest.param(kind, changes, message, id=f"{kind}: {next(iter(changes))} {next(iter(changes.values()))!r:.9}")
        for kind, changes, message in UPDATES
    ],
)
def test_immutable_fields_cannot_be_changed(kind: str, changes: Changes, message: str, api: Api) -> None:
    stored = api.create(VALID[kind])
    with pytest.raises(ApiError, match=message):
        api.replace(changed(stored, changes))


class TestApplicationTask:
    def test_parameters_may_change(self, api: Api) -> None:
        stored = api.create(APPLICATION_TASK)
        replaced = api.replace(changed(stored, {"spec.parameters.rateHz": 30, "spec.parameters.sources": ["car3"]}))
        assert replaced["spec"]["parameters"] == {"region": "north", "sources": ["car3"], "rateHz": 30}

    def test_the_end_is_set_only_once(self, api: Api) -> None:
        stored = api.create(APPLICATION_TASK)
        ended = api.replace(changed(stored, {"spec.endTime": TIME}))
        for value in ("2026-01-02T04:00:00Z", ABSENT):
            with pytest.raises(ApiError, match=r"spec\.endTime: Forbidden: is immutable once set: create another task"):
                api.replace(changed(ended, {"spec.endTime": value}))

    def test_a_task_can_end_whatever_its_event_recorded(self, api: Api) -> None:
        stored = api.create(changed(APPLICATION_TASK, {"spec.event.values.gone": None}))
        ended = api.replace(changed(stored, {"spec.endTime": TIME}))
        assert ended["spec"]["event"] == stored["spec"]["event"]

    def test_a_manually_created_task_needs_only_a_template(self, api: Api) -> None:
        stored = api.create(changed(APPLICATION_TASK, {"spec": {"templateName": "scene-fusion"}}))
        assert stored["spec"]["priority"] == 0

    @pytest.mark.parametrize(
        ("selector", "found"),
        [
            ("spec.templateName=scene-fusion", ["one", "two"]),
            ("spec.templateName=other", ["three"]),
            ("spec.requester.detectorName=intersection-a", ["one"]),
            ("status.instanceName=scene-fusion-abcdefgh", ["two"]),
            ("spec.templateName=scene-fusion,status.instanceName!=scene-fusion-abcdefgh", ["one"]),
        ],
    )
    def test_selectable_fields_work_in_a_selector(self, selector: str, found: list[str], api: Api) -> None:
        api.create(changed(APPLICATION_TASK, {"metadata.name": "one"}))
        api.create(changed(APPLICATION_TASK, {"metadata.name": "two", "spec.requester.detectorName": "other"}))
        api.create(changed(APPLICATION_TASK, {"metadata.name": "three", "spec": {"templateName": "other"}}))
        status = {"status": {"instanceName": "scene-fusion-abcdefgh"}}
        api.patch("ApplicationTask", "two", status, subresource="status")
        assert sorted(each["metadata"]["name"] for each in api.list("ApplicationTask", fields=selector)) == sorted(
            found
        )


class TestStatus:
    @pytest.mark.parametrize("kind", VALID)
    def test_the_status_is_written_separately_from_the_spec(self, kind: str, api: Api) -> None:
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
        assert [each["type"] for each in stored["status"]["conditions"]] == ["Ready"]  # the default

        patched = api.patch(kind, name, {"status": {"conditions": [condition]}}, subresource="status")
        assert patched["status"]["conditions"] == [condition]
        assert patched["metadata"]["generation"] == 1

        ignored = api.replace(changed(patched, CHANGED[kind]), subresource="status")
        assert ignored["spec"] == stored["spec"]

    def test_a_condition_with_an_unknown_status_is_rejected(self, api: Api) -> None:
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
    def test_two_field_managers_share_a_rules_signals_by_name(self, api: Api) -> None:
        api.apply(EVENT_RULE, field_manager="one")
        other = {"name": "braking", "stream": "odometry", "value": "msg.acceleration"}
        api.apply(changed(EVENT_RULE, {"spec.signals": [other]}), field_manager="two")
        stored = api.get("EventRule", EVENT_RULE["metadata"]["name"])
        assert [signal["name"] for signal in stored["spec"]["signals"]] == ["speed", "braking"]

    def test_free_form_data_has_one_field_owner(self, api: Api) -> None:
        for manifest in (EVENT_RULE, APPLICATION_TASK):
            fields = str(api.apply(manifest)["metadata"]["managedFields"])
            assert "'f:parameters': {}" in fields
            assert "'f:vehicles'" not in fields
            assert "'f:nested'" not in fields

    def test_a_selector_is_replaced_as_a_whole(self, api: Api) -> None:
        for manager, labels in (("one", {"site": "north"}), ("two", {"tier": "edge"})):
            selecting = changed(DETECTOR, {"spec.ruleSelector": {"matchLabels": labels}})
            stored = api.apply(selecting, field_manager=manager)
        assert stored["spec"]["ruleSelector"]["matchLabels"] == {"tier": "edge"}

    def test_applying_an_unchanged_object_changes_nothing(self, api: Api) -> None:
        for kind, manifest in VALID.items():
            name = api.apply(manifest)["metadata"]["name"]
            # As the manager does. First, an update stores the default of the status.
            written = api.patch(kind, name, {"status": {"conditions": []}}, subresource="status")
            assert api.apply(manifest)["metadata"]["resourceVersion"] == written["metadata"]["resourceVersion"]


class TestKubectl:
    @pytest.mark.parametrize(
        ("path", "teaches"),
        [
            ("eventrule", "An event to detect in the data of vehicles and stations"),
            ("eventrule.spec.scope", "The subjects of the rule"),
            ("eventrule.spec.scope.pairs.within", "The maximum distance in metres"),
            ("eventrule.spec.when", "the condition that starts an episode"),
            ("detector.spec.streams.key", "captures the name of the client"),
            ("applicationtemplate.spec.parameters.merge", "Union: the items that occur in any array"),
            ("applicationtask.spec.endTime", "Setting it ends the demand at once"),
            ("applicationinstance.status.releaseTime", "The end of the linger time"),
        ],
    )
    def test_explain_prints_the_descriptions(self, path: str, teaches: str, control_plane: ControlPlane) -> None:
        explained = " ".join(control_plane.kubectl("explain", path).split())
        assert teaches in explained

    @pytest.mark.parametrize(
        ("short", "manifest", "columns"),
        [
            ("er", EVENT_RULE, ["NAME", "ENABLED", "READY", "DETECTORS", "WHEN", "AGE", "MESSAGE"]),
            ("det", DETECTOR, ["NAME", "CLOCK", "RULES", "READY", "AGE", "MESSAGE"]),
            ("apptpl", APPLICATION_TEMPLATE, ["NAME", "KEY", "INSTANCES", "MAX", "READY", "AGE", "MESSAGE"]),
            (
                "apptask",
                APPLICATION_TASK,
                ["NAME", "TEMPLATE", "OPERATION", "RULE", "SUBJECT", "INSTANCE", "PHASE", "AGE", "MESSAGE"],
            ),
            (
                "appinst",
                APPLICATION_INSTANCE,
                ["NAME", "TEMPLATE", "KEY", "DEMANDS", "READY", "PHASE", "AGE", "MESSAGE"],
            ),
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
    """Whether the stored object has all written fields; it may have defaults too."""
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


def test_kubectl_applies_the_files_as_they_are(control_plane: ControlPlane) -> None:
    """kubectl has its own YAML parser: it reads a lone y as a boolean."""
    reported = control_plane.kubectl("apply", "--server-side", "--force-conflicts", "--dry-run=server", "-f", str(CRDS))
    assert len(reported.splitlines()) == len(KINDS)
