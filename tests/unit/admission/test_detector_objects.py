"""A Detector's pod: its folders have volumes, its Secrets are mounted, and nothing else changes it."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import pytest
import yaml
from pydantic import ValidationError
from typer.testing import CliRunner

from application_manager.cache.detector_index import DetectorIndex, ProcessedState
from application_manager.commands.cli import app
from application_manager.commands.options import PullPolicy
from application_manager.core.conditions import find
from application_manager.core.health.pods import Trouble, TroubleReason
from application_manager.core.objects.detectors import detector_objects, detector_roles, secrets_of
from application_manager.core.objects.poddefaults import PodDefaults, parse_user
from application_manager.core.objects.rights import detector_rights, merged_rules, rights
from application_manager.core.statuses.rulestatus import NOT_RUN, detector_status, running
from tests.cluster.manifests import DETECTOR
from tests.guides import guide, yaml_blocks
from tests.unit.manager_objects import NOW
from wayside.api import Detector
from wayside.api.detector import DetectorStatus

IMAGE = "wayside:1"
ON_A_CLAIM = {
    "volumes": [{"name": "data", "persistentVolumeClaim": {"claimName": "town"}}],
    "volumeMounts": [{"name": "data", "mountPath": "/data"}],
}
DEFAULTS = PodDefaults(IMAGE)


def detector(**spec: Any) -> Detector:
    raw = copy.deepcopy(DETECTOR)
    raw["metadata"] |= {"namespace": "site", "uid": "u-1", "generation": 1}
    raw["spec"] |= {"mode": "Standalone"} | spec
    return Detector.model_validate(raw)


def pod(one: Detector, defaults: PodDefaults = DEFAULTS) -> dict[str, Any]:
    *_, deployment = detector_objects(one, defaults)
    spec: dict[str, Any] = deployment["spec"]["template"]["spec"]
    return spec


def mounted(one: Detector) -> dict[str, Any]:
    """The volume mounts by path."""
    spec = pod(one)
    volumes = {each["name"]: each for each in spec["volumes"]}
    (container,) = spec["containers"]
    found = {each["mountPath"]: volumes.pop(each["name"]) for each in container["volumeMounts"]}
    assert not volumes
    return {path: {key: value for key, value in each.items() if key != "name"} for path, each in found.items()}


def test_each_folder_is_in_a_persistent_volume_if_a_claim_is_given() -> None:
    given = detector(
        state={"path": "/var/lib/wayside"},
        recordings={"path": "/data/recordings"},
        database={
            "uriSecretName": "mongo",
            "spool": {"path": "/data/spool"},
            "files": {"path": "/var/lib/wayside/files"},
        },
        pod={
            "volumes": [
                {"name": "data", "persistentVolumeClaim": {"claimName": "town"}},
                {"name": "models", "configMap": {"name": "risk", "defaultMode": 292}},
            ],
            "volumeMounts": [
                {"name": "models", "mountPath": "/models", "readOnly": True},
                {"name": "data", "mountPath": "/data", "subPath": "town"},
            ],
        },
    )
    assert mounted(given) == {
        "/tmp": {"emptyDir": {"sizeLimit": "256Mi"}},
        "/data": {"persistentVolumeClaim": {"claimName": "town"}},
        "/models": {"configMap": {"name": "risk", "defaultMode": 292}},
        "/var/lib/wayside": {"emptyDir": {}},
        "/etc/wayside/secrets/mongo": {"secret": {"secretName": "mongo", "optional": True}},
    }


def test_folders_with_a_common_name_prefix_have_separate_volumes() -> None:
    given = detector(state={"path": "/data2"}, pod=ON_A_CLAIM)
    assert mounted(given)["/data2"] == {"emptyDir": {}}


def test_the_mounted_secrets_are_those_of_the_detector_and_those_permitted_to_rules() -> None:
    mqtt = {"name": "broker", "plugin": "mqtt", "parameters": {"url": "mqtts://b", "credentialsSecretName": "broker"}}
    given = detector(
        zenoh={"connect": ["tls/zenoh:7447"], "tlsSecretName": "zenoh"},
        sources=[mqtt],
        database={"uriSecretName": "mongo"},
        pod={"secretNames": ["pager", "mongo"]},
    )
    assert secrets_of(given) == ["broker", "mongo", "pager", "zenoh"]


def test_fields_that_the_detector_reloads_do_not_change_the_pod() -> None:
    changed = detector(clientTimeout="7s", ruleSelector={"matchLabels": {"a": "b"}}, buffer={"bytes": "1Gi"})
    assert detector_objects(changed, DEFAULTS) == detector_objects(detector(), DEFAULTS)


@pytest.mark.parametrize(("user", "fields"), [(None, {}), (7, {"runAsUser": 7, "runAsGroup": 7, "fsGroup": 7})])
def test_the_pods_user_is_the_managers_or_left_to_the_cluster(user: int | None, fields: dict[str, int]) -> None:
    made = detector_objects(detector(), replace(DEFAULTS, user=user))[-1]["spec"]["template"]["spec"]
    security = made["securityContext"]
    assert {name: security[name] for name in security if name in ("runAsUser", "runAsGroup", "fsGroup")} == fields
    assert security["runAsNonRoot"] is True
    assert parse_user("cluster" if user is None else str(user)) == user
    for wrong in ("0", "root", "-1"):
        with pytest.raises(ValueError, match="must be a user ID"):
            parse_user(wrong)


def test_all_objects_are_owned_by_the_detector_and_the_pod_runs_with_its_account() -> None:
    found = detector_objects(detector(), DEFAULTS)
    assert [each["kind"] for each in found] == ["ServiceAccount", "Role", "RoleBinding", "Deployment"]
    for each in found:
        (owner,) = each["metadata"]["ownerReferences"]
        assert (owner["kind"], owner["name"], owner["uid"], owner["controller"]) == (
            "Detector",
            "intersection-a",
            "u-1",
            True,
        )
    account, _, binding, deployment = found
    name = account["metadata"]["name"]
    assert binding["subjects"] == [{"kind": "ServiceAccount", "namespace": "site", "name": name}]
    assert deployment["spec"]["template"]["spec"]["serviceAccountName"] == name
    selector = deployment["spec"]["selector"]["matchLabels"].items()
    assert selector <= deployment["spec"]["template"]["metadata"]["labels"].items()


def test_the_detectors_image_and_resources_override_the_defaults() -> None:
    (container,) = pod(detector())["containers"]
    assert container["image"] == IMAGE
    assert container["resources"]["limits"] == {"memory": "1Gi"}
    own = {"image": "other:2", "resources": {"limits": {"cpu": "2"}}, "nodeSelector": {"site": "a"}}
    given = pod(detector(pod=own))
    (container,) = given["containers"]
    assert container["image"] == "other:2"
    assert container["resources"]["limits"] == {"cpu": "2"}
    assert given["nodeSelector"] == {"site": "a"}


def test_settings_for_all_detectors_are_in_each_pod_and_own_settings_win() -> None:
    environment = {"OTEL_EXPORTER_OTLP_ENDPOINT": "http://all:4318", "B": "all"}
    defaults = PodDefaults(IMAGE, PullPolicy.ALWAYS, ("registry",), environment)
    key = {"name": "collector", "key": "headers"}
    own = [{"name": "OTEL_EXPORTER_OTLP_HEADERS", "valueFrom": {"secretKeyRef": key}}, {"name": "B", "value": "own"}]
    toleration = {"key": "roadside", "operator": "Exists", "effect": "NoExecute", "tolerationSeconds": 60}
    affinity = {"podAffinity": {"requiredDuringSchedulingIgnoredDuringExecution": []}}
    placed = {"affinity": affinity, "priorityClassName": "roadside", "runtimeClassName": "gvisor"}
    more = {"imagePullSecrets": [{"name": "own"}, {"name": "registry"}], "securityContext": {"fsGroup": 7}}
    given = pod(detector(pod={"env": own, "tolerations": [toleration], **placed, **more}), defaults)
    assert {field: given[field] for field in placed} == placed
    assert (given["securityContext"]["fsGroup"], given["securityContext"]["runAsNonRoot"]) == (7, True)
    (container,) = given["containers"]
    assert given["imagePullSecrets"] == [{"name": "registry"}, {"name": "own"}]
    assert given["tolerations"] == [toleration]
    assert container["imagePullPolicy"] == "Always"
    assert container["env"][2:] == [
        {"name": "OTEL_EXPORTER_OTLP_ENDPOINT", "value": "http://all:4318"},
        {"name": "OTEL_EXPORTER_OTLP_HEADERS", "valueFrom": {"secretKeyRef": key}},
        {"name": "B", "value": "own"},
    ]
    names = [each["name"] for each in container["env"]]
    assert names[:2] == ["POD_NAME", "POD_UID"]


def test_metrics_over_tls_are_probed_over_tls_and_their_secret_is_hidden_from_rules() -> None:
    given = pod(detector(), PodDefaults(IMAGE, metrics_secret="metrics"))
    (container,) = given["containers"]
    folder = "/etc/wayside/metrics-certificates"
    assert f"--metrics-certificates={folder}" in container["command"]
    assert {container[each]["httpGet"]["scheme"] for each in container if each.endswith("Probe")} == {"HTTPS"}
    assert {"name": "metrics", "mountPath": folder, "readOnly": True} in container["volumeMounts"]
    assert {"name": "metrics", "secret": {"secretName": "metrics", "optional": True}} in given["volumes"]


@pytest.mark.parametrize(
    ("options", "logged"),
    [
        (["--detector-metrics-secret", "a"], "have no effect without --detector-image"),
        (["--detector-env", "A=b"], "have no effect without --detector-image"),
        (
            ["--detector-image", "a", "--detector-env", "A"],
            "must be NAME=VALUE, with a name of letters, digits and _; got 'A'",
        ),
        (["--detector-image", "a", "--detector-env", "POD_NAME=b"], "POD_NAME is set automatically in each pod"),
    ],
)
def test_invalid_options_for_the_pods_are_rejected(options: list[str], logged: str) -> None:
    refused = CliRunner().invoke(app, ["run", *options])
    assert refused.exit_code == 2
    assert logged in " ".join(refused.stderr.replace("│", " ").split())


@pytest.mark.parametrize(
    ("spec", "logged"),
    [
        ({"state": {"path": "state"}}, "state.path: must be an absolute path"),
        ({"recordings": {"path": "/"}}, "recordings.path: must be an absolute path"),
        ({"recordings": {"path": "/data/../etc"}}, "must be an absolute path"),
        ({"mode": None, "pod": {}}, "set mode to Standalone or Sidecar, or remove pod"),
        ({"pod": {"volumes": [{"name": "a", "emptyDir": {}, "csi": {}}]}}, "give exactly one of persistentVolumeClaim"),
        ({"pod": {"volumes": [{"name": "a", "hostPath": {"path": "/"}}]}}, "hostPath"),
        ({"pod": {"volumes": [{"name": "scratch", "emptyDir": {}}]}}, "are reserved"),
        ({"pod": {"volumeMounts": [{"name": "a", "mountPath": "/a"}]}}, "volumeMounts: /a: there is no volume a"),
        (
            {
                "pod": {
                    "volumes": [{"name": "a", "emptyDir": {}}],
                    "volumeMounts": [{"name": "a", "mountPath": "/a"}] * 2,
                }
            },
            "volumeMounts: /a is given twice",
        ),
        ({"pod": {"env": [{"name": "A", "value": ""}, {"name": "A", "value": "b"}]}}, "env: A is given twice"),
        ({"pod": {"env": [{"name": "A"}]}}, "give exactly one of value and valueFrom"),
        (
            {"pod": {"env": [{"name": "POD_UID", "value": "1"}]}},
            "POD_UID are set automatically in each pod",
        ),
        ({"pod": {"tolerations": [{"effect": "NoSchedule"}]}}, "without key, operator must be Exists"),
        (
            {"pod": {"tolerations": [{"key": "a", "operator": "Exists", "value": "b"}]}},
            "with operator Exists, value must be absent",
        ),
    ],
)
def test_invalid_pod_specs_are_rejected(spec: dict[str, Any], logged: str) -> None:
    with pytest.raises(ValidationError, match="Detector") as refused:
        detector(**spec)
    assert logged in str(refused.value)


def test_without_a_mode_folders_are_local_paths() -> None:
    assert detector(mode=None, state={"path": "state"}).spec.folders == {"state.path": "state"}


def test_the_manager_has_every_right_that_it_grants() -> None:
    def verbs(rules: list[dict[str, Any]]) -> set[tuple[str, str, str]]:
        return {
            (group, resource, verb)
            for rule in rules
            for group in rule["apiGroups"]
            for resource in rule["resources"]
            for verb in rule["verbs"]
        }

    unnamed = [rule for rule in merged_rules(rights({}, detectors=True)) if "resourceNames" not in rule]
    assert verbs(merged_rules(detector_rights("town"))) <= verbs(unnamed)
    assert not {"escalate", "bind", "*"} & {verb for _, _, verb in verbs(unnamed)}
    assert verbs(merged_rules(rights({}))) < verbs(unnamed)


def test_a_command_prints_the_account_of_a_detector_that_somebody_else_runs() -> None:
    done = CliRunner().invoke(app, ["detector-rbac", "town", "-n", "site"])
    assert list(yaml.safe_load_all(done.stdout)) == detector_roles("site", "town")
    refused = CliRunner().invoke(app, ["detector-rbac", "Town", "-n", "site"])
    assert refused.exit_code == 2
    assert "must be a Detector name" in refused.stderr


def deployment(available: int) -> dict[str, Any]:
    return {
        "kind": "Deployment",
        "metadata": {"name": "detector-town", "generation": 1},
        "spec": {"replicas": 1},
        "status": {"observedGeneration": 1, "replicas": 1, "updatedReplicas": 1, "availableReplicas": available},
    }


def test_a_detector_runs_when_its_pod_is_ready_and_otherwise_reports_the_reason() -> None:
    assert running(deployment(1), []).holds
    assert running(None, []).reason == "NotReady"
    assert "0 of 1 pods" in running(deployment(0), []).message
    pulled = running(deployment(0), [Trouble(TroubleReason.IMAGE_PULL_FAILED, "cannot pull image x: not found")])
    assert (pulled.holds, pulled.reason) == (False, "ImagePullFailed")
    assert "cannot pull image x" in pulled.message


def test_the_condition_is_removed_with_the_mode() -> None:
    logged = detector_status(detector(), [], NOW, NOT_RUN)
    condition = find(logged.conditions, "Running")
    assert condition is not None
    assert "--detector-image" in condition.message
    without = detector(mode=None).model_copy(update={"status": logged})
    assert find(detector_status(without, [], NOW).conditions, "Running") is None
    unknown_yet = detector().model_copy(update={"status": logged})
    assert find(detector_status(unknown_yet, [], NOW).conditions, "Running") == condition


def readiness(status: DetectorStatus) -> dict[str, tuple[str, str]]:
    return {each.type: (each.status, each.reason) for each in status.conditions if each.type != "Accepted"}


def test_a_detector_is_not_ready_before_this_generation_of_it_was_processed() -> None:
    pending = {"Running": ("Unknown", "Pending"), "Ready": ("Unknown", "Pending")}
    assert readiness(detector_status(detector(), [], NOW)) == pending
    runs = running(deployment(1), [])
    ready = detector_status(detector(), [], NOW, runs)
    assert readiness(ready) == {"Running": ("True", "Running"), "Ready": ("True", "Ready")}
    restarted = detector().model_copy(update={"status": ready})
    assert readiness(detector_status(restarted, [], NOW)) == readiness(ready)

    metadata = restarted.metadata.model_copy(update={"generation": 2})
    changed = restarted.model_copy(update={"metadata": metadata})
    assert readiness(detector_status(changed, [], NOW)) == pending
    index = DetectorIndex(processed={("site", changed.name): ProcessedState("u-1", 1, runs)})
    assert index.running(restarted) == runs
    assert index.running(changed) is None
    namesake = changed.metadata.model_copy(update={"uid": "u-2", "generation": 1})
    assert index.running(changed.model_copy(update={"metadata": namesake})) is None


def test_a_restarted_manager_keeps_that_a_detector_does_not_run() -> None:
    pulled = running(deployment(0), [Trouble(TroubleReason.IMAGE_PULL_FAILED, "cannot pull image x: not found")])
    failing = detector().model_copy(update={"status": detector_status(detector(), [], NOW, pulled)})
    assert readiness(detector_status(failing, [], NOW))["Ready"] == ("False", "ImagePullFailed")


def test_the_guide_shows_persistent_folders_and_the_default_resources() -> None:
    text = guide("detectors")
    shown = yaml.safe_load(yaml_blocks(text)[0])
    shown["metadata"] |= {"namespace": "site", "uid": "u-1"}
    one = Detector.model_validate(shown)
    assert mounted(one) == {
        "/tmp": {"emptyDir": {"sizeLimit": "256Mi"}},
        "/data": {"persistentVolumeClaim": {"claimName": "town-data"}},
        "/etc/wayside/secrets/pager": {"secret": {"secretName": "pager", "optional": True}},
        "/etc/wayside/secrets/zenoh-client": {"secret": {"secretName": "zenoh-client", "optional": True}},
    }
    (container,) = pod(detector())["containers"]
    assert container["resources"] == {"requests": {"cpu": "100m", "memory": "256Mi"}, "limits": {"memory": "1Gi"}}
    assert "requests of 100m and 256Mi, a limit of 1Gi" in text
