"""The pure part of charts as applications: Helm's output becomes objects, or a rejection with a reason."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from application_manager.core.objects.charts import ChartObjects, ChartRequest, ChartSource, parse_chart
from application_manager.core.objects.ownership import ApplyProblem
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import ChartPending, Renderer, RenderError, Rendering
from tests.unit.manager_objects import instance, template
from wayside.api.applicationtemplate import ApplicationTemplateSpec, Helm

SOURCE = ChartSource("app", "1.0.0", "https://charts.example.com")
CHART = {"chart": SOURCE.chart, "version": SOURCE.version, "repository": SOURCE.repository}

SERVICE = """\
---
# Source: app/templates/service.yaml
apiVersion: v1
kind: Service
metadata: {name: app}
spec: {ports: [{port: 80}]}
"""


def objects(text: str) -> ChartObjects:
    outcome = parse_chart(SOURCE, text)
    assert isinstance(outcome, ChartObjects), outcome
    return outcome


def refusal(text: str) -> str:
    outcome = parse_chart(SOURCE, text)
    assert isinstance(outcome, ApplyProblem), outcome
    return outcome.message


def made(text: str = SERVICE, helm: dict[str, Any] | None = None, **values: Any) -> tuple[Rendering, ChartRequest]:
    requested = []

    def charts(request: ChartRequest) -> ChartObjects:
        requested.append(request)
        return objects(text)

    spec = {"helm": CHART | (helm or {}), "parameters": values.pop("declared", {})}
    rendering = Renderer(template(**spec), Policy()).render(instance(parameters=values), charts)
    return rendering, requested[0]


def test_each_document_is_an_object_with_its_file() -> None:
    found = objects(
        SERVICE + "---\n# Source: app/templates/empty.yaml\n---\n" + SERVICE.replace("name: app", "name: b")
    )
    assert [each.file for each in found.objects] == ["templates/service.yaml"] * 2
    assert [each.manifest["metadata"]["name"] for each in found.objects] == ["app", "b"]


def test_scalars_are_read_as_kubernetes_tools_do() -> None:
    text = SERVICE + "date: 2026-01-02\ntime: 12:30:45\nbig: 1e3\nmode: 0644\nhalf: .5\nname: v1\nempty:\n"
    manifest = objects(text).objects[0].manifest
    assert {key: manifest[key] for key in ("date", "time", "big", "mode", "half", "name", "empty")} == {
        "date": "2026-01-02",
        "time": "12:30:45",
        "big": 1000.0,
        "mode": 420,
        "half": 0.5,
        "name": "v1",
        "empty": None,
    }


def test_a_hook_is_refused_with_its_file_and_a_remedy() -> None:
    hook = SERVICE.replace("{name: app}", '{name: app, annotations: {"helm.sh/hook": pre-install}}')
    assert refusal(SERVICE + hook) == (
        "spec.helm: chart app 1.0.0 of https://charts.example.com: Service app in templates/service.yaml is a hook "
        "(pre-install), and hooks are not supported: disable it in the chart's values, or do its work in the "
        "application"
    )


def test_a_crd_is_refused_with_its_file_and_a_remedy() -> None:
    crd = SERVICE.replace("kind: Service", "kind: CustomResourceDefinition").replace("templates/service", "crds/thing")
    assert "CustomResourceDefinition app in crds/thing.yaml is a CRD, which is cluster-wide" in refusal(crd)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "renders no objects with these values"),
        (
            "---\n# Source: app/templates/a.yaml\n- 1\n",
            "templates/a.yaml contains a document without apiVersion",
        ),
        ("---\n# Source: app/templates/a.yaml\n{\n", "templates/a.yaml is not YAML"),
        (SERVICE * 257, "has 257 objects; at most 256"),
    ],
)
def test_invalid_chart_objects_are_rejected(text: str, problem: str) -> None:
    assert problem in refusal(text)


def test_a_charts_objects_are_made_as_manifests_are() -> None:
    rendering, request = made(
        helm={"values": {"rate": "${parameters.rate}"}}, declared={"rate": {"type": "number"}}, rate=5.0
    )
    assert request == ChartRequest(SOURCE, "site", "app", '{"rate":5}')
    (service,) = rendering.manifests
    assert service["metadata"]["namespace"] == "site"
    assert service["metadata"]["labels"]["wayside.dev/instance"] == "app"


def test_restrictions_of_manifests_apply_to_chart_objects() -> None:
    with pytest.raises(RenderError) as caught:
        made(
            SERVICE.replace("kind: Service", "kind: ServiceAccount")
            + SERVICE.replace("{name: app}", "{name: app, namespace: x}")
        )
    account, elsewhere = caught.value.problems
    assert account.startswith("spec.helm: templates/service.yaml of chart app: v1/ServiceAccount is not a kind")
    assert account.endswith("or disable it in the chart's values")
    assert "'x' is not the template's own namespace" in elsewhere


def test_a_pending_chart_is_not_an_error_and_an_unavailable_one_has_its_own_reason() -> None:
    renderer = Renderer(template(helm=CHART), Policy())
    with pytest.raises(ChartPending):
        renderer.render(instance(), lambda request: None)
    with pytest.raises(RenderError, match="helm is not available") as caught:
        renderer.render(instance())
    assert caught.value.reason == "ChartUnavailable"


def test_a_wrong_expression_in_the_values_is_found_when_the_template_is_compiled() -> None:
    with pytest.raises(RenderError, match=r"spec\.helm\.values\.rate.*`parameters.rat` does not exist"):
        Renderer(template(helm=CHART | {"values": {"rate": "${parameters.rat}"}}), Policy())


@pytest.mark.parametrize(
    ("helm", "problem"),
    [
        ({"chart": "oci://registry.example/app"}, "needs an exact version"),
        ({"chart": "app", "version": "1.0.0"}, "chart app needs a repository"),
        ({"chart": "oci://r/app", "version": "1.0.0", "repository": "https://x"}, "an OCI reference"),
        ({"chart": "/charts/app", "version": "1.0.0"}, "is a path: remove version and repository"),
        ({"chart": "app", "version": "^1", "repository": "https://x"}, "version"),
        ({"chart": "--post-renderer", "version": "1.0.0", "repository": "https://x"}, "chart"),
    ],
)
def test_a_chart_has_one_source_and_one_version(helm: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValidationError, match=problem):
        Helm.model_validate(helm)


def test_a_template_has_manifests_or_a_chart() -> None:
    for spec in ({}, {"helm": CHART, "manifests": [{"apiVersion": "v1", "kind": "ConfigMap"}]}):
        with pytest.raises(ValidationError, match="exactly one of manifests and helm"):
            ApplicationTemplateSpec.model_validate(spec)
