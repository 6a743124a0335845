"""`application-manager inject`: pod templates get the detector, and other objects pass unchanged."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner, Result

from application_manager.commands.cli import EXPECTED, app
from application_manager.core.objects.sidecars import CONTAINER
from wayside.process import commandline

DETECTOR = """
apiVersion: wayside.dev/v1alpha1
kind: Detector
metadata: {name: town}
spec:
  mode: Sidecar
  serviceAccountNames: [vehicle]
  streams: [{name: pose, key: 'vehicles/${client:*}/pose', encoding: json}]
"""
IMAGE = ("--detector-image", "wayside:1")

Json = dict[str, Any]


@pytest.fixture
def detector(tmp_path: Path) -> Path:
    (file := tmp_path / "detector.yaml").write_text(DETECTOR)
    return file


def template(**metadata: Any) -> Json:
    """A pod, but for its kind and name."""
    containers = [{"name": "main", "image": "app:1"}]
    labelled = {"labels": {"wayside.dev/detector": "town"}, **metadata}
    return {"metadata": labelled, "spec": {"serviceAccountName": "vehicle", "containers": containers}}


def injected(*arguments: str, given: Any) -> Result:
    """Run it; `given`: documents for stdin."""
    text = given if isinstance(given, str) else yaml.safe_dump_all(given)
    return CliRunner().invoke(app, ["inject", "-f", "-", *arguments], input=text)


def has_it(pod: Json) -> bool:
    return [each["name"] for each in pod["spec"].get("initContainers", [])] == [CONTAINER]


WORKLOADS: list[tuple[str, tuple[str, ...]]] = [
    ("Pod", ()),
    ("Deployment", ("spec", "template")),
    ("StatefulSet", ("spec", "template")),
    ("DaemonSet", ("spec", "template")),
    ("Job", ("spec", "template")),
    ("CronJob", ("spec", "jobTemplate", "spec", "template")),
]


@pytest.mark.parametrize(("kind", "path"), WORKLOADS)
def test_pod_templates_of_workloads_are_injected(detector: Path, kind: str, path: tuple[str, ...]) -> None:
    raw: Json = template()
    for step in reversed(path):
        raw = {step: raw}
    manifest = {"apiVersion": "x/v1", "kind": kind} | ({"metadata": {"name": "cars"}} if path else {}) | raw
    done = injected("-f", str(detector), *IMAGE, given=[manifest])
    assert (done.exit_code, done.stderr) == (0, "")
    made = yaml.safe_load(done.stdout)
    inner: Any = made
    for step in path:
        inner = inner[step]
    assert has_it(inner)
    again = injected("-f", str(detector), *IMAGE, given=done.stdout)
    assert again.stdout == done.stdout


def test_other_objects_pass_unchanged_and_lists_are_searched(detector: Path) -> None:
    pods = [{"apiVersion": "v1", "kind": "Pod", **template(name="a")}, {"apiVersion": "v1", "kind": "Pod", "spec": {}}]
    other = {
        "apiVersion": "example.com/v1",
        "kind": "Fleet",
        "metadata": {"name": "f"},
        "spec": {"template": template()},
    }
    listed = {"apiVersion": "v1", "kind": "List", "items": pods}
    done = injected("-f", str(detector), *IMAGE, given=[listed, other])
    assert done.exit_code == 0
    made, passed = yaml.safe_load_all(done.stdout)
    assert has_it(made["items"][0])
    assert made["items"][1] == pods[1]
    assert passed == other


def test_the_detectors_image_wins_over_the_option(detector: Path) -> None:
    detector.write_text(DETECTOR + "  pod: {image: 'own:2'}\n")
    done = injected("-f", str(detector), given=[{"kind": "Pod", **template()}])
    assert yaml.safe_load(done.stdout)["spec"]["initContainers"][0]["image"] == "own:2"


def error(*arguments: str) -> str:
    """The program's output on stderr; exit code 2."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("KUBECONFIG", "/nonexistent")
        reported: list[str] = []
        patch.setattr("builtins.print", lambda *words, **_: reported.append(" ".join(map(str, words))))
        assert commandline.run_cli(app, "application-manager", EXPECTED, ["inject", *arguments]) == 2
    return "\n".join(reported)


def test_invalid_input_is_reported_by_place_with_the_remedy(detector: Path, tmp_path: Path) -> None:
    (pod := tmp_path / "pod.yaml").write_text(yaml.safe_dump({"kind": "Pod", **template(name="car")}))
    assert "Detector town has no image: give --detector-image" in error("-f", str(pod), "-f", str(detector))
    assert "Detector town is in none of the files" in error("-f", str(pod), *IMAGE)
    assert "No such file or directory: give a readable YAML file, or -" in error("-f", str(tmp_path / "none.yaml"))
    (broken := tmp_path / "broken.yaml").write_text("a: [")
    assert f"-f {broken}: is not YAML" in error("-f", str(broken))
    broken.write_text("- a\n")
    assert "contains a document that is not a manifest" in error("-f", str(broken))
    detector.write_text(DETECTOR.replace("mode: Sidecar", "mode: Passenger"))
    logged = error("-f", str(pod), "-f", str(detector), *IMAGE)
    assert "Detector town: spec.mode" in logged
