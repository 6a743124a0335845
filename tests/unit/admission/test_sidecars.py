"""Injection into a pod that requests a detector: once, harmless to the pod, and only if its Detector allows it."""

from __future__ import annotations

import base64
import copy
import json
import re
from dataclasses import replace
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from typer.testing import CliRunner

from application_manager.commands.cli import app
from application_manager.core.findings.injections import answer_pod, injection, read_pod
from application_manager.core.findings.reviews import ReviewError
from application_manager.core.objects.detectors import detector_objects, sidecar_roles
from application_manager.core.objects.poddefaults import PodDefaults
from application_manager.core.objects.sidecars import CONTAINER, added, addition, patch, sidecar_pods
from application_manager.core.statuses.rulestatus import running_in_pods
from tests.cluster.manifests import DETECTOR
from tests.guides import guide, yaml_blocks
from tests.unit.admission.test_detector_objects import ON_A_CLAIM
from wayside.api import Detector

IMAGE = "wayside:1"
DEFAULTS = PodDefaults(IMAGE)
LABELS = {"wayside.dev/detector": "town"}
MIRROR = {"kubernetes.io/config.mirror": "x"}
TOKEN = "/var/run/secrets/kubernetes.io/serviceaccount"

Json = dict[str, Any]


def detector(**spec: Any) -> Detector:
    raw = copy.deepcopy(DETECTOR)
    raw["metadata"] |= {"name": "town", "namespace": "site", "uid": "u-1", "generation": 1}
    raw["spec"] |= {"mode": "Sidecar", "serviceAccountNames": ["vehicle"]} | spec
    return Detector.model_validate(raw)


def pod(**spec: Any) -> Json:
    main = {"name": "main", "image": "app:1"}
    return {
        "apiVersion": "v1",
        "kind": "Pod",
        "metadata": {"name": "car", "labels": LABELS},
        "spec": {"serviceAccountName": "vehicle", "containers": [main]} | spec,
    }


def injected(one: Json, of: Detector) -> Json:
    found = addition(one["spec"], of, DEFAULTS)
    return one if found is None else one | {"spec": added(one["spec"], found)}


def sidecar(one: Json) -> Json:
    (found,) = (each for each in one["spec"]["initContainers"] if each["name"] == CONTAINER)
    return dict(found)


def why_not(one: Json, of: Detector | None, defaults: PodDefaults | None = DEFAULTS) -> str:
    found = injection(one["metadata"], one["spec"], "site", of, defaults)
    assert found.addition is None
    return found.why_not or ""


names = st.sampled_from(["main", "wayside-detector", "log", "wayside-scratch", "wayside-token", "data"])
ports = st.lists(st.fixed_dictionaries({"containerPort": st.integers(9463, 9466)}), max_size=3)
containers = st.lists(
    st.fixed_dictionaries({"name": names, "image": st.just("a:1")}, optional={"ports": ports}),
    max_size=4,
    unique_by=lambda each: str(each["name"]),
)
volumes = st.lists(
    st.fixed_dictionaries({"name": names, "emptyDir": st.just({})}),
    max_size=3,
    unique_by=lambda each: str(each["name"]),
)
specs = st.fixed_dictionaries(
    {"containers": containers},
    optional={
        "initContainers": st.one_of(st.none(), containers),
        "volumes": st.one_of(st.none(), volumes),
        "hostNetwork": st.booleans(),
        "serviceAccountName": st.just("vehicle"),
    },
)
detectors = st.sampled_from(
    [
        detector(),
        detector(zenoh={"connect": ["tls/zenoh:7447"], "tlsSecretName": "zenoh"}),
        detector(state={"path": "/state"}, pod={**ON_A_CLAIM, "secretNames": ["pager"]}),
    ]
)


def applied(document: Json, operations: list[Json]) -> Json:
    """A JSON patch of additions, as RFC 6902 has it."""
    document = copy.deepcopy(document)
    for each in operations:
        assert each["op"] == "add"
        *path, last = each["path"].split("/")[1:]
        target: Any = document
        for step in path:
            target = target[step]
        if last == "-":
            target.append(each["value"])
        else:
            target[last] = each["value"]
    return document


@given(specs, detectors)
def test_the_sidecar_is_injected_once_and_the_patch_removes_nothing(spec: Json, of: Detector) -> None:
    before = copy.deepcopy(spec)
    metadata = {"name": "car", "labels": LABELS}
    found = injection(metadata, spec, "site", of, DEFAULTS)
    assert spec == before
    if found.addition is None:
        return
    after = added(spec, found.addition)
    assert applied({"spec": spec}, patch(spec, found.addition)) == {"spec": after}
    again = injection(metadata, after, "site", of, DEFAULTS)
    assert (again.addition, again.why_not) == (None, None)
    for field in ("initContainers", "volumes"):
        there = spec.get(field) or []
        assert after[field][: len(there)] == there
        every = [each["name"] for each in after[field]]
        assert [name for name in every if every.count(name) > 1] == []
    assert {key: after[key] for key in spec if key not in ("initContainers", "volumes")} == {
        key: spec[key] for key in spec if key not in ("initContainers", "volumes")
    }
    mine = sidecar({"spec": after})
    paths = [each["mountPath"] for each in mine["volumeMounts"]]
    assert len(set(paths)) == len(paths)
    assert {each["name"] for each in mine["volumeMounts"]} <= {each["name"] for each in after["volumes"]}
    taken = {port["containerPort"] for each in spec["containers"] for port in each.get("ports", [])}
    assert not taken & {port["containerPort"] for port in mine.get("ports", [])}


def test_no_container_of_the_pod_waits_for_the_sidecar() -> None:
    made = sidecar(injected(pod(), detector()))
    assert made["restartPolicy"] == "Always"
    assert "startupProbe" not in made
    assert "readinessProbe" not in made
    assert made["livenessProbe"]["httpGet"]["port"] == made["ports"][0]["name"]
    assert made["livenessProbe"]["initialDelaySeconds"] == 120
    first = {"name": "prepare", "image": "a:1"}
    assert [each["name"] for each in injected(pod(initContainers=[first]), detector())["spec"]["initContainers"]] == [
        "prepare",
        CONTAINER,
    ]


def test_the_sidecar_uses_its_own_token_and_passes_the_restricted_standard() -> None:
    made = injected(pod(automountServiceAccountToken=False), detector())
    mine = sidecar(made)
    assert mine["command"] == [
        "detector", "run", "--name=town", "--metrics-port=9464", "--as-pod", "--namespace=$(POD_NAMESPACE)",
    ]  # fmt: skip
    reported = {each["name"]: each["valueFrom"]["fieldRef"]["fieldPath"] for each in mine["env"]}
    assert reported == {"POD_NAME": "metadata.name", "POD_UID": "metadata.uid", "POD_NAMESPACE": "metadata.namespace"}
    (token,) = (each["name"] for each in mine["volumeMounts"] if each["mountPath"] == TOKEN)
    (volume,) = (each for each in made["spec"]["volumes"] if each["name"] == token)
    assert volume["projected"]["sources"][0]["serviceAccountToken"]["path"] == "token"
    assert mine["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "capabilities": {"drop": ["ALL"]},
        "readOnlyRootFilesystem": True,
        "runAsNonRoot": True,
        "runAsUser": 65532,
        "runAsGroup": 65532,
        "seccompProfile": {"type": "RuntimeDefault"},
    }


def test_the_sidecars_folders_secrets_and_resources_match_a_standalone_detector() -> None:
    pod_fields = {"image": "own:2", "secretNames": ["pager"], "resources": {"limits": {"memory": "2Gi"}}}
    given_one = {
        "state": {"path": "/state"},
        "pod": pod_fields,
        "zenoh": {"connect": ["tls/z:7447"], "tlsSecretName": "z"},
    }
    mine = sidecar(injected(pod(), detector(**given_one)))
    *_, deployment = detector_objects(detector(**given_one, mode="Standalone", serviceAccountNames=None), DEFAULTS)
    (own,) = deployment["spec"]["template"]["spec"]["containers"]
    assert (mine["image"], mine["resources"]) == (own["image"], own["resources"])
    paths = {each["mountPath"] for each in mine["volumeMounts"]}
    assert paths == {each["mountPath"] for each in own["volumeMounts"]} | {TOKEN}


def test_the_guides_pod_gets_the_guides_detector() -> None:
    section = guide("detectors").partition("## As a sidecar")[2]
    of, requested = yaml.safe_load_all(yaml_blocks(section)[0])
    found = injection(requested["metadata"], requested["spec"], "default", Detector.model_validate(of), DEFAULTS)
    assert found.why_not is None
    assert found.addition is not None


def test_pull_secrets_are_added_and_conflicts_that_block_the_pod_are_avoided() -> None:
    variables = [{"name": "TOKEN", "valueFrom": {"secretKeyRef": {"name": "pager", "key": "token"}}}]
    defaults = PodDefaults(IMAGE, pull_secrets=("registry", "mirror"))
    given_one = pod(imagePullSecrets=[{"name": "registry"}, {"name": "own"}])["spec"]
    found = addition(given_one, detector(pod={"env": variables}), defaults)
    assert found is not None
    after = added(given_one, found)
    assert [each["name"] for each in after["imagePullSecrets"]] == ["registry", "own", "mirror"]
    (token,) = (each for each in sidecar({"spec": after})["env"] if each["name"] == "TOKEN")
    assert token["valueFrom"]["secretKeyRef"] == {"name": "pager", "key": "token", "optional": True}


def test_on_the_host_network_the_sidecar_opens_no_port() -> None:
    mine = sidecar(injected(pod(hostNetwork=True), detector()))
    assert "ports" not in mine
    assert "livenessProbe" not in mine
    assert not [each for each in mine["command"] if "metrics" in each]


@pytest.mark.parametrize(
    ("requested", "of", "logged"),
    [
        (pod(), None, "namespace site has no valid Detector 'town'"),
        (pod(), detector(mode="Standalone", serviceAccountNames=None), "has mode Standalone: give it mode Sidecar"),
        (pod(), detector(mode=None, serviceAccountNames=None), "has no mode: give it mode Sidecar"),
        (pod(serviceAccountName="other"), detector(), "has only vehicle, not other"),
        (pod(serviceAccountName=None), detector(), "has only vehicle, not default"),
        (pod(), detector(serviceAccountNames=[]), "has none, not vehicle"),
        (pod(volumes=[{"name": "wayside-scratch", "hostPath": {}}]), detector(), "name wayside-scratch is reserved"),
        (pod(), detector(state={"path": TOKEN}), f"has two volumes at {TOKEN}"),
        (pod() | {"metadata": {"labels": LABELS, "annotations": MIRROR}}, detector(), "static"),
    ],
)  # fmt: skip
def test_a_pod_without_its_sidecar_gets_the_reason_and_the_remedy(
    requested: Json, of: Detector | None, logged: str
) -> None:
    assert logged in why_not(requested, of)


def test_a_detector_that_is_not_accepted_is_not_injected() -> None:
    wrong = [{"name": "pose", "key": "vehicles/${client:*}/pose", "encoding": "json", "stamp": "msg.t +"}]
    assert "is not accepted" in why_not(pod(), detector(streams=wrong))


def test_a_manager_without_a_detector_image_reports_it() -> None:
    assert "--detector-image" in why_not(pod(), detector(), None)


def test_a_pod_without_a_request_or_with_a_container_of_that_name_is_left_alone() -> None:
    unlabelled = pod() | {"metadata": {"name": "car"}}
    assert why_not(unlabelled, None) == ""
    theirs = pod(containers=[{"name": CONTAINER, "image": "mine:1"}])
    assert why_not(theirs, detector()) == ""


def review(one: Json, **more: Any) -> Json:
    request = {
        "uid": "q",
        "kind": {"group": "", "kind": "Pod"},
        "operation": "CREATE",
        "namespace": "site",
        "object": one,
    }
    return {"apiVersion": "admission.k8s.io/v1", "kind": "AdmissionReview", "request": request | more}


def test_the_answer_always_allows_with_a_patch_or_a_warning() -> None:
    requested = read_pod(review(pod()))
    response = answer_pod(
        requested, injection(requested.pod["metadata"], requested.pod["spec"], "site", detector(), DEFAULTS)
    )["response"]
    assert (response["uid"], response["allowed"], response["patchType"]) == ("q", True, "JSONPatch")
    assert applied(pod(), json.loads(base64.b64decode(response["patch"]))) == injected(pod(), detector())
    response = answer_pod(
        requested, injection(requested.pod["metadata"], requested.pod["spec"], "site", None, DEFAULTS)
    )["response"]
    assert (response["allowed"], "patch" in response) == (True, False)
    assert "created without a detector: label wayside.dev/detector" in response["warnings"][0]


def test_only_new_pods_are_considered() -> None:
    for more in (
        {"operation": "UPDATE"},
        {"subResource": "ephemeralcontainers"},
        {"kind": {"group": "apps", "kind": "Pod"}},
    ):
        assert read_pod(review(pod(), **more)).pod == {}
    for none in (None, {}, {"apiVersion": "admission.k8s.io/v1"}, {"apiVersion": "admission.k8s.io/v1", "request": {}}):
        with pytest.raises(ReviewError):
            read_pod(none)


def test_only_the_listed_accounts_are_bound_to_the_detectors_role() -> None:
    role, binding = detector_objects(detector(serviceAccountNames=["vehicle", "bus"]), DEFAULTS)
    assert [each["name"] for each in binding["subjects"]] == ["bus", "vehicle"]
    rules = {
        (resource, verb, *rule.get("resourceNames", []))
        for rule in role["rules"]
        for resource in rule["resources"]
        for verb in rule["verbs"]
    }
    assert ("detectors", "hold-as-pod", "town") in rules
    assert {each for each in rules if each[1] == "hold"} == set()
    assert detector_objects(detector(serviceAccountNames=[]), DEFAULTS)[1]["subjects"] == []


def test_manual_injection_prints_the_same_rights() -> None:
    options = ["detector-rbac", "town", "-n", "site", "--pod-account", "vehicle"]
    done = CliRunner().invoke(app, options)
    assert list(yaml.safe_load_all(done.stdout)) == sidecar_roles("site", "town", ["vehicle"])
    refused = CliRunner().invoke(app, [*options[:-1], "Vehicle"])
    assert "must be a service account name" in refused.stderr


def state(one: Json, **how: Any) -> Json:
    name = "wayside-detector"
    return one | {"status": {"phase": "Running", "initContainerStatuses": [{"name": name, "image": IMAGE, **how}]}}


def test_the_condition_reports_the_number_of_running_pods_and_the_reasons_of_others() -> None:
    of = detector()
    runs = state(injected(pod(), of), state={"running": {}}, ready=True)
    logged = running_in_pods(of, [runs, pod()])
    assert (logged.holds, logged.message) == (
        True,
        "it runs in 1 of 2 pods with its label; 1 without a detector: their Events report why",
    )
    waiting = {"waiting": {"reason": "ErrImagePull", "message": "not found"}}
    logged = running_in_pods(of, [runs, state(injected(pod(), of), state=waiting)])
    assert (logged.holds, logged.reason) == (False, "ImagePullFailed")
    assert logged.message == "it runs in 1 of 2 pods with its label: cannot pull image wayside:1: not found"
    broken = runs | {"status": runs["status"] | {"containerStatuses": [{"name": "main", "state": waiting}]}}
    assert running_in_pods(of, [broken]).holds
    assert [each["spec"]["initContainers"][0]["name"] for each in sidecar_pods([broken, pod()])] == [CONTAINER]
    logged = running_in_pods(of, [state(injected(pod(), of), state={"waiting": {"reason": "PodInitializing"}})])
    assert (logged.holds, logged.reason, logged.message) == (
        False,
        "NotReady",
        "it runs in 0 of 1 pods with its label",
    )
    logged = running_in_pods(of, [pod()])
    assert (logged.holds, logged.reason) == (False, "NotReady"), "the detector was not injected"
    assert running_in_pods(detector(serviceAccountNames=[]), []).reason == "NoAccounts"


def test_the_names_of_its_volumes_are_labels_and_unique_beside_those_of_a_user() -> None:
    longest = "v" * 55
    given = {"volumes": [{"name": longest, "emptyDir": {}}], "volumeMounts": [{"name": longest, "mountPath": "/data"}]}
    of = detector(pod={**given, "secretNames": ["pager.site-a"]}, state={"path": "/state"})
    found = addition(pod()["spec"], of, replace(DEFAULTS, metrics_secret="metrics"))
    assert found is not None
    names = [each["name"] for each in found.items["volumes"]]
    assert len(set(names)) == len(names) == 6
    assert all(re.fullmatch("[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?", each) for each in names)
    for reserved in ("scratch", "metrics", "token", "folder-0", "secret-0"):
        with pytest.raises(ValidationError, match="are reserved"):
            detector(pod={"volumes": [{"name": reserved, "emptyDir": {}}]})


def test_finished_pods_are_ignored() -> None:
    of, killed = detector(), {"terminated": {"exitCode": 137}}
    one = state(injected(pod(restartPolicy="OnFailure"), of), state=killed)
    over = one | {"status": one["status"] | {"containerStatuses": [{"name": "main", "state": killed}]}}
    deleted = one | {"metadata": one["metadata"] | {"deletionTimestamp": "2026-01-01T00:00:00Z"}}
    logged = running_in_pods(of, [over, deleted])
    assert (logged.holds, logged.message) == (True, "it runs in 0 of 0 pods with its label")
    assert running_in_pods(of, [one]).reason == "CrashLoop"


@pytest.mark.parametrize(
    ("spec", "logged"),
    [
        ({"mode": "Standalone"}, "serviceAccountNames has no effect without mode Sidecar"),
        ({"mode": None}, "serviceAccountNames has no effect without mode Sidecar"),
        (
            {"pod": {"nodeSelector": {"a": "b"}, "securityContext": {"fsGroup": 1}}},
            "mode Sidecar uses an existing pod: remove pod.nodeSelector and pod.securityContext",
        ),
        ({"serviceAccountNames": ["a", "a"]}, "serviceAccountNames: a is given twice"),
        ({"state": {"path": "state"}}, "state.path: must be an absolute path"),
        (
            {"pod": {"resources": {"requests": {"memory": "2Gi"}}}},
            "requests.memory: must be at most limits.memory, 1Gi; got 2Gi",
        ),
        (
            {"pod": {"resources": {"requests": {"x": "1"}}}},
            "requests: must be cpu, memory, ephemeral-storage or an extended resource",
        ),
        ({"pod": {"resources": {"requests": {"a.b/gpu": "1"}}}}, "requests.a.b/gpu: must equal limits.a.b/gpu; got 1"),
    ],
)
def test_invalid_settings_are_rejected_by_field(spec: Json, logged: str) -> None:
    with pytest.raises(ValidationError) as refused:
        detector(**spec)
    assert logged in str(refused.value)
