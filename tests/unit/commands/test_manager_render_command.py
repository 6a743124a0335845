"""`application-manager render` prints the resulting objects from files alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from application_manager.commands.cli import EXPECTED, app
from tests.unit.manager_objects import DEPLOYMENT
from wayside.process import commandline

TEMPLATE: dict[str, Any] = {
    "apiVersion": "wayside.dev/v1alpha1",
    "kind": "ApplicationTemplate",
    "metadata": {"name": "fusion"},
    "spec": {
        "parameters": {"region": {"type": "string"}, "sources": {"type": "array", "merge": "Union"}},
        "key": "${parameters.region}",
        "manifests": [DEPLOYMENT],
    },
}


def task(name: str, **spec: Any) -> dict[str, Any]:
    spec = {"templateName": "fusion", **spec}
    return {"apiVersion": "wayside.dev/v1alpha1", "kind": "ApplicationTask", "metadata": {"name": name}, "spec": spec}


@dataclass(frozen=True)
class Result:
    exit_code: int
    stdout: str
    stderr: str


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Callable[..., Result]:
    def command(*arguments: str) -> Result:
        code = commandline.run_cli(app, "application-manager", EXPECTED, arguments)
        return Result(code, *capsys.readouterr())

    return command


@pytest.fixture
def render(tmp_path: Path, command: Callable[..., Result]) -> Any:
    def render(template: dict[str, Any], *tasks: dict[str, Any], options: tuple[str, ...] = ()) -> Result:
        (tmp_path / "template.yaml").write_text(yaml.safe_dump(template))
        folder = tmp_path / "tasks"
        folder.mkdir()
        (folder / "tasks.yaml").write_text(yaml.safe_dump_all(tasks))
        files = ["--templates", str(tmp_path / "template.yaml"), "--tasks", str(folder)]
        return command("render", *files, *options)

    return render


def test_merged_instances_and_their_manifests_are_printed(render: Any) -> None:
    pairs = [task(n, parameters={"region": "n", "sources": s}) for n, s in (("a", ["x"]), ("b", ["y", "x"]))]
    result = render(TEMPLATE, *pairs)
    assert result.exit_code == 0, result.stderr
    instance, deployment = yaml.safe_load_all(result.stdout)
    assert instance["kind"] == "ApplicationInstance"
    merged = {"region": "n", "sources": ["x", "y"]}
    assert instance["spec"] == {"templateName": "fusion", "key": "n", "parameters": merged, "suspended": False}
    assert deployment["kind"] == "Deployment"
    assert deployment["metadata"]["name"] == instance["metadata"]["name"]


def test_refusals_go_to_stderr_and_the_rest_is_printed(render: Any) -> None:
    result = render(
        TEMPLATE,
        task("good", parameters={"region": "n"}),
        task("bad", parameters={"region": 1}),
        task("x", templateName="y"),
    )
    assert result.exit_code == 1
    assert len(list(yaml.safe_load_all(result.stdout))) == 2
    bad, unknown = result.stderr.splitlines()
    assert bad.startswith("ApplicationTask default/bad: InvalidParameters: spec.parameters.region: 1 is not of type")
    assert unknown.startswith("ApplicationTask default/x: TemplateNotFound")


def test_a_template_that_cannot_be_rendered_is_reported_with_its_place(render: Any) -> None:
    broken = {**TEMPLATE, "spec": {**TEMPLATE["spec"], "manifests": [{**DEPLOYMENT, "metadata": {"name": "${nam}"}}]}}
    result = render(broken, task("a", parameters={"region": "n"}))
    assert result.exit_code == 1
    assert result.stderr.startswith("ApplicationTemplate default/fusion: spec.manifests[0].metadata.name, line 1")


def test_a_kind_that_is_not_allowed_is_refused(render: Any) -> None:
    result = render(TEMPLATE, task("a", parameters={"region": "n"}), options=("--allowed-kinds", "v1/ConfigMap"))
    assert result.exit_code == 1
    assert "the allowed kinds are v1/ConfigMap" in result.stderr


def test_a_task_that_waits_and_a_capped_sum_are_reported_without_an_error(render: Any) -> None:
    load = {"type": "number", "merge": "Sum", "maximum": 5}
    template = {
        **TEMPLATE,
        "spec": {**TEMPLATE["spec"], "parameters": {**TEMPLATE["spec"]["parameters"], "load": load}},
    }
    night = task("night", parameters={"region": "elsewhere"})
    night["spec"]["operation"] = "Suspend"
    result = render(template, *(task(name, parameters={"region": "n", "load": 4}) for name in ("a", "b")), night)
    assert result.exit_code == 0, result.stderr
    assert "night: NothingRuns: no task deploys instance" in result.stderr
    assert "load: the sum of 2 values, 8, is capped at the maximum of 5" in result.stderr


def test_bad_files_and_options_are_one_line_and_exit_code_2(
    render: Any, command: Callable[..., Result], tmp_path: Path
) -> None:
    wrong = render({**TEMPLATE, "spec": {"manifests": "x"}})
    assert wrong.exit_code == 2
    assert f"{tmp_path / 'template.yaml'}:" in wrong.stderr
    assert "spec.manifests" in wrong.stderr
    missing = command("render", "--templates", "nowhere.yaml", "--tasks", "nowhere.yaml")
    assert missing.exit_code == 2
    assert "nowhere.yaml: there is no such file" in missing.stderr
    option = command("run", "--resync", "soon")
    assert option.exit_code == 2
    assert "must be a duration" in option.stderr
    assert option.stderr.startswith("application-manager: ")
    assert option.stderr.endswith("see application-manager run --help\n")
    assert option.stderr.count("\n") == 1


def test_without_a_cluster_run_reports_it(
    monkeypatch: pytest.MonkeyPatch, command: Callable[..., Result], tmp_path: Path
) -> None:
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "none"))
    monkeypatch.delenv("KUBERNETES_SERVICE_HOST", raising=False)
    result = command("run")
    assert result.exit_code == 2
    assert "set KUBECONFIG" in result.stderr
