"""The objects that the chart renders from its values, and the values that it rejects."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from application_manager.core.objects.detectors import detector_objects
from application_manager.core.objects.poddefaults import PodDefaults, parse_environment
from application_manager.core.objects.sidecars import SIDECAR_LABEL, addition
from tests.fleets import write_fleet
from tests.helm import ensure_tools
from tests.helm.wayside_chart import CHART, Helm, HelmError, Rendered, Values
from wayside.api import Detector
from wayside.api.__main__ import crd_files

Object = dict[str, Any]
EXAMPLE = Path(__file__).parents[2] / "examples" / "cooperative-recording"


DETECTOR: Object = {
    "name": "town",
    "spec": {"streams": [{"name": "a", "key": "a/*", "encoding": "json", "client": "a"}]},
}


@pytest.fixture(scope="module")
def helm(tmp_path_factory: pytest.TempPathFactory) -> Helm:
    return Helm(ensure_tools().helm, tmp_path_factory.mktemp("helm") / "home")


def test_each_rendering_is_the_same(helm: Helm) -> None:
    """So that tools which only render, such as Argo CD, find no difference where nothing changed."""
    assert helm.rendered({}).manifests == helm.rendered({}).manifests


@pytest.mark.parametrize("keep", [True, False])
def test_the_crds_are_complete_and_kept_if_requested(helm: Helm, keep: bool) -> None:
    rendered = helm.rendered({"crds": {"keep": keep}}).of("CustomResourceDefinition")
    wanted = {text["metadata"]["name"]: text["spec"] for text in map(yaml.safe_load, crd_files().values())}
    assert {each["metadata"]["name"]: each["spec"] for each in rendered} == wanted
    policies = {each["metadata"].get("annotations", {}).get("helm.sh/resource-policy") for each in rendered}
    assert policies == {"keep" if keep else None}
    assert not helm.rendered({"crds": {"install": False}}).of("CustomResourceDefinition")


@pytest.mark.parametrize(("replicas", "budgets"), [(1, 0), (2, 1)])
def test_a_disruption_budget_is_rendered_only_for_several_managers(helm: Helm, replicas: int, budgets: int) -> None:
    rendered = helm.rendered({"manager": {"replicas": replicas}})
    assert len(rendered.of("PodDisruptionBudget")) == budgets


def test_the_linter_finds_nothing(helm: Helm) -> None:
    assert "0 chart(s) failed" in helm("lint", "--strict", str(CHART))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"manager": {"replica": 2}}, "replica"),
        ({"manager": {"replicas": 0}}, "replicas"),
        ({"manager": {"resync": "60"}}, "resync"),
        ({"manager": {"resync": "1d"}}, "resync"),
        ({"commonLabels": {"team": 7}}, "team"),
        ({"webhook": {"certificates": {"from": "Nowhere"}}}, "from"),
        ({"manager": {"lease": "wayside-manager"}}, "lease"),
        ({"detectors": [{"name": "Town", "spec": {}}]}, "name"),
        ({"image": {"digest": "latest"}}, "digest"),
        ({"tracing": {"variables": {"PATH": "/bin"}}}, "PATH"),
        (
            {"detectors": [DETECTOR], "manager": {"detectors": {"run": False}}},
            "town is of mode Standalone, but manager.detectors.run is false",
        ),
        (
            {"detectors": [DETECTOR], "manager": {"namespaces": ["north", "south"]}},
            r"Detector town is in namespace town, which .* does not manage: .*\(north, south\)",
        ),
        ({"detectors": [DETECTOR], "manager": {"grant": ["north"]}}, r"does not manage: add it to manager\.grant"),
        ({"manager": {"namespaces": ["a"], "grant": ["b"]}}, r"manager\.grant and manager\.namespaces: remove one"),
        ({"manager": {"allowedKinds": ["v1/Secret"]}}, r"v1/Secret needs manager\.namespaces"),
    ],
)
def test_an_invalid_value_is_rejected_by_its_name(helm: Helm, values: Values, message: str) -> None:
    with pytest.raises(HelmError, match=message):
        helm.rendered(values)


def test_the_pods_of_the_mining_job_make_one_dataset(helm: Helm, tmp_path: Path) -> None:
    """The test runs the containers' commands one after another."""
    write_fleet(tmp_path, 4, 5.0, broken=1)
    given: Values = {"enabled": True, "shares": 2, "claim": "datasets", "recordings": [str(tmp_path / "drives")]}
    given |= {name: (tmp_path / f"{name}.yaml").read_text() for name in ("detector", "rules")}
    rendered = helm.rendered({"mining": given})
    job = rendered.one("Job")["spec"]
    assert (job["completionMode"], job["completions"], job["parallelism"]) == ("Indexed", 2, 2)
    (container,) = job["template"]["spec"]["containers"]
    assert {mount["mountPath"] for mount in container["volumeMounts"]} == {"/configuration", "/dataset", "/tmp"}
    (configuration,) = (each for each in rendered.of("ConfigMap") if "mining" in each["metadata"]["name"])
    for name, text in configuration["data"].items():
        (tmp_path / name).write_text(text)
    variables = {"/configuration": str(tmp_path), "/dataset": str(tmp_path / "claim")}
    for index in range(2):
        arguments = [*container["command"], *container["args"]]
        for name, value in {**variables, "$(JOB_COMPLETION_INDEX)": str(index)}.items():
            arguments = [each.replace(name, value, 1) for each in arguments]
        assert arguments.pop(0) == "detector"
        subprocess.run([sys.executable, "-m", "detector.commands.cli", *arguments], check=True)
        assert (tmp_path / "claim" / "dataset" / "report.html").exists() is (index == 1)
    with pytest.raises(HelmError, match="mining needs detector, rules, recordings and claim"):
        helm.rendered({"mining": {"enabled": True}})


def test_additional_volumes_can_be_mounted_into_the_manager(helm: Helm) -> None:
    volume, mount = {"name": "tools", "emptyDir": {}}, {"name": "tools", "mountPath": "/tools"}
    given = {"volumes": [volume], "volumeMounts": [mount], "extraArgs": ["--helm=/tools/helm"]}
    pod = helm.rendered({"manager": given}).one("Deployment", "wayside-manager")["spec"]["template"]["spec"]
    assert volume in pod["volumes"]
    assert mount in pod["containers"][0]["volumeMounts"]
    assert pod["containers"][0]["args"][-1] == "--helm=/tools/helm"


def manager_arguments(rendered: Rendered) -> list[str]:
    (container,) = rendered.one("Deployment", "wayside-manager")["spec"]["template"]["spec"]["containers"]
    return list(container["args"])


def test_a_detector_in_the_values_is_run_by_the_manager_unless_disabled(helm: Helm) -> None:
    mine = [DETECTOR, DETECTOR | {"name": "van", "run": False}, {"name": "own", "spec": {"mode": "Standalone"}}]
    rendered = helm.rendered({"detectors": mine}, "--api-versions", "wayside.dev/v1alpha1/Detector")
    assert {each["metadata"]["name"]: each["spec"].get("mode") for each in rendered.of("Detector")} == {
        "town": "Standalone",
        "van": None,
        "own": "Standalone",
    }
    assert {each["metadata"]["name"] for each in rendered.of("NetworkPolicy")} == {
        "wayside-manager",
        "wayside-detector-town",
        "wayside-detector-own",
    }
    assert {each["metadata"]["name"] for each in rendered.of("Deployment")} == {"wayside-manager"}
    off = helm.rendered({"manager": {"detectors": {"run": False}}})
    assert not [each for each in manager_arguments(off) if "detector" in each]


def test_detectors_use_the_managers_pull_secrets_and_are_selected_by_its_labels(helm: Helm) -> None:
    values: Values = {
        "image": {"repository": "registry.test/wayside", "tag": "7", "pullPolicy": "Always"},
        "imagePullSecrets": [{"name": "registry"}],
        "manager": {"namespaces": ["north"], "detectors": {"metrics": {"tlsSecretName": "metrics"}}},
        "detectors": [DETECTOR | {"namespace": "north", "service": {"ports": [7447], "type": "NodePort"}}],
        "monitoring": {"podMonitor": {"enabled": True}},
    }
    rendered = helm.rendered(values)
    assert manager_arguments(rendered)[-4:] == [
        "--detector-image=registry.test/wayside:7",
        "--detector-metrics-secret=metrics",
        "--detector-pull-policy=Always",
        "--detector-pull-secret=registry",
    ]
    metadata = {"name": "town", "namespace": "north", "uid": "u"}
    town = Detector.model_validate({"kind": "Detector", "metadata": metadata, "spec": DETECTOR["spec"]})
    *_, deployment = detector_objects(town, PodDefaults("wayside:1"))
    labels = deployment["spec"]["template"]["metadata"]["labels"]
    service = rendered.one("Service", "wayside-detector-town")
    policy = rendered.one("NetworkPolicy", "wayside-detector-town")
    monitor = rendered.one("PodMonitor", "wayside-detectors")["spec"]
    selectors = [service["spec"]["selector"], policy["spec"]["podSelector"]["matchLabels"]]
    for selector in (*selectors, monitor["selector"]["matchLabels"]):
        assert selector.items() <= labels.items()
    assert service["metadata"]["namespace"] == policy["metadata"]["namespace"] == "north"
    assert monitor["namespaceSelector"] == {"matchNames": ["north"]}
    (container,) = deployment["spec"]["template"]["spec"]["containers"]
    (monitored,) = monitor["podMetricsEndpoints"]
    assert monitored["port"] in {each["name"] for each in container["ports"]}
    tls = {"ca": {"secret": {"name": "metrics", "key": "ca.crt"}}, "serverName": "wayside-detectors"}
    for each in rendered.of("PodMonitor"):
        assert [(it["scheme"], it["tlsConfig"]) for it in each["spec"]["podMetricsEndpoints"]] == [("https", tls)]


def test_sidecars_are_scraped_at_their_own_port(helm: Helm) -> None:
    monitor = helm.rendered({"monitoring": {"podMonitor": {"enabled": True}}}).one("PodMonitor", "wayside-sidecars")
    assert monitor["spec"]["selector"]["matchExpressions"] == [{"key": SIDECAR_LABEL, "operator": "Exists"}]
    stream = {"name": "pose", "key": "vehicles/${client:*}/pose", "encoding": "json"}
    spec = {"mode": "Sidecar", "streams": [stream]}
    of = Detector.model_validate({"kind": "Detector", "metadata": {"name": "van"}, "spec": spec})
    made = addition({}, of, PodDefaults("wayside:1"))
    assert made is not None
    (container,) = made.items["initContainers"]
    assert [each["port"] for each in monitor["spec"]["podMetricsEndpoints"]] == [container["ports"][0]["name"]]


def test_traces_go_to_the_endpoint_from_both_programs(helm: Helm) -> None:
    endpoint, variables = "http://collector:4318", {"OTEL_TRACES_SAMPLER": "always_on"}
    rendered = helm.rendered({"tracing": {"endpoint": endpoint, "variables": variables}})
    wanted = {"OTEL_EXPORTER_OTLP_ENDPOINT": endpoint, **variables}
    (container,) = rendered.one("Deployment", "wayside-manager")["spec"]["template"]["spec"]["containers"]
    assert wanted.items() <= {each["name"]: each.get("value") for each in container["env"]}.items()
    handed_on = [each.partition("=")[2] for each in container["args"] if each.startswith("--detector-env=")]
    assert parse_environment(handed_on) == wanted


def test_the_examples_values_make_its_detector_and_expose_it_to_vehicles(helm: Helm) -> None:
    example = yaml.safe_load((EXAMPLE / "detector.yaml").read_text())["spec"]
    values = yaml.safe_load((EXAMPLE / "helm" / "values.yaml").read_text())
    rendered = helm.rendered(values, "--api-versions", "wayside.dev/v1alpha1/Detector")
    spec = rendered.one("Detector", "town")["spec"]
    assert spec.pop("mode") == "Standalone"
    assert spec.pop("zenoh") == {"mode": "peer", "listen": ["tcp/0.0.0.0:7447"]}
    assert spec == {key: value for key, value in example.items() if key != "zenoh"}
    ports = rendered.one("Service", "wayside-detector-town")["spec"]["ports"]
    assert [each["targetPort"] for each in ports] == [7447]


def test_a_new_version_of_the_chart_alone_recreates_no_pod(helm: Helm, tmp_path: Path) -> None:
    newer = tmp_path / "wayside"
    shutil.copytree(CHART, newer)
    described = (newer / "Chart.yaml").read_text()
    (newer / "Chart.yaml").write_text(re.sub(r"(?m)^version: .*$", "version: 9.9.9", described))
    values = {"router": {"enabled": True, "tls": {"enabled": False}, "accessControl": {"enabled": False}}}
    before = list(helm.rendered(values).of("Deployment"))
    text = helm("template", "wayside", str(newer), "--namespace", "town", values=values)
    after = [each for each in yaml.safe_load_all(text) if each and each["kind"] == "Deployment"]
    assert [each["spec"]["template"] for each in after] == [each["spec"]["template"] for each in before]
    assert "9.9.9" in text


def test_common_labels_are_on_every_object_and_every_pod(helm: Helm) -> None:
    rendered = helm.rendered({"commonLabels": {"team": "mobility"}, "detectors": [DETECTOR]})
    assert {each["metadata"]["labels"].get("team") for each in rendered.manifests if each["kind"] != "Pod"} == {
        "mobility"
    }
    assert rendered.one("Deployment")["spec"]["template"]["metadata"]["labels"]["team"] == "mobility"


def test_user_ids_and_the_registry_can_be_left_to_the_cluster(helm: Helm) -> None:
    nobody = dict.fromkeys(("runAsUser", "runAsGroup", "fsGroup"))
    given: Values = {
        "imageRegistry": "registry.example:5000/mirror/",
        "podSecurityContext": {**nobody, "supplementalGroups": [7]},
        "containerSecurityContext": {"runAsUser": 1234},
        "router": {"enabled": True, "tls": {"enabled": False}, "accessControl": {"enabled": False}},
    }
    pods = list(helm.rendered(given).pods())
    assert len(pods) >= 2
    for pod in pods:
        assert pod["securityContext"] == {
            "runAsNonRoot": True,
            "seccompProfile": {"type": "RuntimeDefault"},
            "supplementalGroups": [7],
        }
        for container in pod["containers"]:
            assert container["image"].startswith("registry.example:5000/mirror/")
            assert container["securityContext"]["runAsUser"] == 1234
            assert container["securityContext"]["capabilities"] == {"drop": ["ALL"]}
    manager = helm.rendered(given).one("Deployment", "wayside-manager")["spec"]["template"]["spec"]["containers"][0]
    assert f"--detector-image={manager['image']}" in manager["args"]
    assert "--detector-user=cluster" in manager["args"]
    for user, options in ((65532, []), (1000, ["--detector-user=1000"])):
        arguments = manager_arguments(helm.rendered({"podSecurityContext": {"runAsUser": user}}))
        assert [each for each in arguments if "detector-user" in each] == options


def test_the_deployment_and_the_webhooks_follow_the_values(helm: Helm) -> None:
    given: Values = {
        "manager": {
            "annotations": {"reloader/auto": "true"},
            "revisionHistoryLimit": 2,
            "strategy": {"type": "Recreate"},
            "probes": {"liveness": {"periodSeconds": 60}},
        },
        "webhook": {"failurePolicy": "Fail", "timeoutSeconds": 9, "injection": {"failurePolicy": "Fail"}},
        "extraObjects": [
            {
                "apiVersion": "v1",
                "kind": "ConfigMap",
                "metadata": {"name": "more"},
                "data": {"of": "{{ .Release.Name }}"},
            }
        ],
    }
    rendered = helm.rendered(given)
    deployment = rendered.one("Deployment", "wayside-manager")
    assert deployment["metadata"]["annotations"] == {"reloader/auto": "true"}
    assert (deployment["spec"]["revisionHistoryLimit"], deployment["spec"]["strategy"]) == (2, {"type": "Recreate"})
    (container,) = deployment["spec"]["template"]["spec"]["containers"]
    assert container["livenessProbe"] == {
        "httpGet": {"path": "/healthz", "port": "metrics"},
        "periodSeconds": 60,
        "timeoutSeconds": 5,
        "failureThreshold": 3,
    }
    assert container["readinessProbe"]["httpGet"]["path"] == "/readyz"
    (validating,) = rendered.one("ValidatingWebhookConfiguration")["webhooks"]
    (mutating,) = rendered.one("MutatingWebhookConfiguration")["webhooks"]
    assert [(each["failurePolicy"], each["timeoutSeconds"]) for each in (validating, mutating)] == [
        ("Fail", 9),
        ("Fail", 5),
    ]
    assert rendered.one("ConfigMap", "more")["data"] == {"of": "wayside"}
    with pytest.raises(HelmError, match="failurePolicy"):
        helm.rendered({"webhook": {"failurePolicy": "Sometimes"}})
