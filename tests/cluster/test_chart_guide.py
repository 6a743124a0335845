"""docs/install.md: its values render, and its lists match the chart."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import yaml

from charts.generate import FILES
from tests.cluster.api import Api
from tests.helm import ensure_tools
from tests.helm.wayside_chart import CHART, Helm, Rendered, names

GUIDE = Path("docs/install.md").read_text(encoding="utf-8")


@pytest.fixture
def rendered(tmp_path: Path) -> Rendered:
    (example,) = re.findall(r"```yaml\n(.*?)```", GUIDE, re.DOTALL)
    return Helm(ensure_tools().helm, tmp_path / "home").rendered(yaml.safe_load(example))


def test_the_example_with_all_values_renders_all_objects(rendered: Rendered, api: Api) -> None:
    assert names(rendered.manifests) >= {
        ("Deployment", "wayside-manager"), ("Deployment", "wayside-router"),
        ("PodDisruptionBudget", "wayside-manager"), ("Detector", "town"), ("EventRule", "fast"),
        ("ServiceMonitor", "wayside-manager"), ("PodMonitor", "wayside-detectors"), ("PrometheusRule", "wayside"),
        ("ConfigMap", "wayside-dashboard"), ("NetworkPolicy", "wayside-detector-town"),
    }  # fmt: skip
    for each in rendered.of("Detector", "EventRule"):
        each["metadata"]["namespace"] = api.namespace
        api.apply(each, dry_run=True)
    groups = rendered.one("PrometheusRule")["spec"]["groups"]
    alerts = [rule["alert"] for group in groups for rule in group["rules"]]
    assert alerts == re.findall(r"^\| `(Wayside\w+)` \|", GUIDE, re.MULTILINE)
    dashboard = json.loads(rendered.one("ConfigMap", "wayside-dashboard")["data"]["wayside.json"])
    assert dashboard == json.loads((FILES / "monitoring" / "dashboard.json").read_text())


def test_every_pod_meets_the_restricted_standard_and_writes_only_where_a_volume_is(rendered: Rendered) -> None:
    pods = list(rendered.pods())
    assert len(pods) == 3
    for pod in pods:
        assert pod["securityContext"]["runAsNonRoot"] is True
        assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        for container in pod["containers"]:
            assert container["securityContext"] == {
                "allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]}
            }  # fmt: skip
            assert {"requests", "limits"} <= container["resources"].keys()


def test_the_schema_has_every_value() -> None:
    values, schema = yaml.safe_load((CHART / "values.yaml").read_text()), json.loads(
        (CHART / "values.schema.json").read_text()
    )  # fmt: skip

    def compare(given: dict[str, object], known: dict[str, dict[str, object]], where: str) -> None:
        assert given.keys() == known.keys() - {"global"}, where
        for name, value in given.items():
            inner = known[name].get("properties")
            if isinstance(value, dict) and isinstance(inner, dict):
                compare(value, inner, f"{where}.{name}")

    compare(values, schema["properties"], "values")
