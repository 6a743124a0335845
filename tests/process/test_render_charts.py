"""`application-manager render` renders charts as a manager does, with a real helm."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests import programs
from tests.helm import ensure_tools
from tests.helm.charts import APPLICATION, HOOK, write_chart


@pytest.fixture(scope="module")
def helm() -> Path:
    return ensure_tools().helm


def template(chart: str) -> dict[str, Any]:
    values = {"sources": "${parameters.sources}", "image": "app:2"}
    parameters = {"sources": {"type": "array", "items": "string", "merge": "Union"}}
    return {
        "apiVersion": "wayside.dev/v1alpha1",
        "kind": "ApplicationTemplate",
        "metadata": {"name": "app"},
        "spec": {"parameters": parameters, "helm": {"chart": chart, "values": values}},
    }


def task(source: str) -> dict[str, Any]:
    return {
        "apiVersion": "wayside.dev/v1alpha1",
        "kind": "ApplicationTask",
        "metadata": {"name": source},
        "spec": {"templateName": "app", "parameters": {"sources": [source]}},
    }


def render(folder: Path, helm: str, manifests: list[Mapping[str, Any]]) -> subprocess.CompletedProcess[str]:
    (folder / "app.yaml").write_text(yaml.safe_dump_all(manifests))
    files = ["--templates", "app.yaml", "--tasks", "app.yaml"]
    options = ["--helm", helm, "--chart-folder", str(folder / "charts"), "--chart-cache", str(folder / "cache")]
    return programs.run("application-manager", "render", *files, *options, folder=folder)


def test_the_chart_rendered_with_the_merged_values_is_printed(helm: Path, tmp_path: Path) -> None:
    chart = write_chart(tmp_path / "charts", "app")
    done = render(tmp_path, str(helm), [template(str(chart)), task("car1"), task("car2")])
    assert (done.returncode, done.stderr) == (0, "")
    made = {each["kind"]: each for each in yaml.safe_load_all(done.stdout)}
    assert made.keys() == {"ApplicationInstance", "ConfigMap", "Deployment"}
    assert made["ConfigMap"]["data"]["sources"] == "car1,car2"
    assert made["Deployment"]["spec"]["template"]["spec"]["containers"][0]["image"] == "app:2"


def test_a_chart_that_the_manager_would_reject_is_rejected(helm: Path, tmp_path: Path) -> None:
    chart = write_chart(tmp_path / "charts", "app", {**APPLICATION, "templates/migrate.yaml": HOOK})
    done = render(tmp_path, str(helm), [template(str(chart)), task("car1")])
    assert done.returncode == 1
    assert "hook" in done.stderr


def test_without_helm_the_command_reports_that_helm_is_missing(tmp_path: Path) -> None:
    chart = write_chart(tmp_path / "charts", "app")
    done = render(tmp_path, "no-such-helm", [template(str(chart)), task("car1")])
    assert done.returncode == 1
    assert "no-such-helm" in done.stderr
    assert "--helm" in done.stderr
