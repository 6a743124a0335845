"""Helm charts as applications: real charts, a real helm, a repository over HTTP and an OCI registry."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.cluster.api import Api, Object
from tests.cluster.children import GRACE
from tests.cluster.expected_objects import condition, end, start_manager, task
from tests.cluster.processes import Process, Processes
from tests.helm import Tools, ensure_tools
from tests.helm.charts import APPLICATION, CRD, HOOK, RANDOM, registry, repository, silence, write_chart

SOURCES = {"sources": {"type": "array", "items": "string", "merge": "Union"}}
VALUES = {"sources": "${parameters.sources}", "image": "app:2"}


@pytest.fixture(scope="session")
def tools() -> Tools:
    return ensure_tools()


@pytest.fixture
def charts(tmp_path: Path) -> Path:
    (folder := tmp_path / "charts").mkdir()
    return folder


@pytest.fixture
def options(tools: Tools, charts: Path, tmp_path: Path) -> list[str]:
    return ["--helm", str(tools.helm), "--chart-folder", str(charts), "--chart-cache", str(tmp_path / "cache")]


@pytest.fixture
def manager(processes: Processes, namespace: str, options: list[str]) -> Process:
    return start_manager(processes, namespace, *options)


def template(name: str, helm: Mapping[str, Any]) -> Object:
    spec = {"parameters": SOURCES, "lifecycle": {"linger": "0s"}, "helm": {"values": VALUES, **helm}}
    return {
        "apiVersion": "wayside.dev/v1alpha1",
        "kind": "ApplicationTemplate",
        "metadata": {"name": name},
        "spec": spec,
    }


def demand(name: str, of: str, *sources: str) -> Object:
    spec = {"templateName": of, "parameters": {"sources": [*sources]}}
    return {**task(name, of=of), "spec": spec}


def wait_for_refusal(api: Api, instance: str, reason: str) -> str:
    raw = api.wait_for(
        "ApplicationInstance",
        instance,
        lambda raw: condition(raw, "Applied").get("reason") == reason,
        what=f"{instance} is not applied, reason {reason}",
    )
    return str(condition(raw, "Applied")["message"])


def wait_for_image(api: Api, name: str, image: str = "app:2") -> Object:
    return api.wait_for(
        "Deployment",
        name,
        lambda raw: raw["spec"]["template"]["spec"]["containers"][0]["image"] == image,
        what=f"{name} runs {image}",
    )


def test_a_chart_is_applied_updated_and_deleted_like_manifests(
    api: Api, manager: Process, charts: Path, kubelet: None
) -> None:
    api.create(template("app", {"chart": str(write_chart(charts, "app"))}))
    api.create(demand("one", "app", "car1"))
    deployment = wait_for_image(api, "app")
    (owner,) = deployment["metadata"]["ownerReferences"]
    assert owner["kind"] == "ApplicationInstance"
    api.wait_for("ConfigMap", "app-sources", lambda raw: raw["data"]["sources"] == "car1", what="the values are set")
    api.wait_for(
        "ApplicationInstance", "app", lambda raw: condition(raw, "Ready").get("status") == "True", what="it is ready"
    )
    assert api.find("Job", "app-try") is None  # the chart's own tests are left out
    api.create(demand("two", "app", "car2"))
    api.wait_for("ConfigMap", "app-sources", lambda raw: raw["data"]["sources"] == "car1,car2", what="they are merged")
    assert api.get("Deployment", "app")["metadata"]["generation"] == deployment["metadata"]["generation"]
    api.create(demand("three", "app"))
    for each in ("one", "two"):
        end(api, each)
    api.wait_gone("ConfigMap", "app-sources")  # pruned: without sources the chart has none
    end(api, "three")
    api.wait_gone("Deployment", "app")


def test_charts_are_pulled_from_a_repository_and_from_a_registry_and_cached(
    api: Api,
    tools: Tools,
    processes: Processes,
    namespace: str,
    options: list[str],
    tmp_path: Path,
) -> None:
    manager = start_manager(processes, namespace, *options)
    ours = [write_chart(tmp_path / "mine", name) for name in ("first", "second")]
    with (
        repository(tools, tmp_path / "web", ours[0]) as (url, requested),
        registry(tools, tmp_path / "oci", ours[1]) as oci,
    ):
        api.create(template("web", {"chart": "first", "version": "1.0.0", "repository": url}))
        api.create(template("oci", {"chart": f"{oci}/second", "version": "1.0.0"}))
        for name in ("web", "oci"):
            api.create(demand(name, name, "car1"))
            wait_for_image(api, name)
        assert any(each.endswith("first-1.0.0.tgz") for each in requested)
    # Both servers are stopped; the fetched charts are cached, also after a restart.
    manager.restart()
    manager.wait_for_output("watching")
    for name in ("web", "oci"):
        api.create(demand(f"{name}-more", name, "car2"))
        api.wait_for(
            "ConfigMap", f"{name}-sources", lambda raw: raw["data"]["sources"] == "car1,car2", what="it continues"
        )


@pytest.mark.parametrize(
    ("files", "logged"),
    [
        ({"templates/hook.yaml": HOOK}, "Job app-migrate in templates/hook.yaml is a hook (pre-install)"),
        ({"crds/things.yaml": CRD}, "is a CRD, which is cluster-wide"),
        ({"templates/random.yaml": RANDOM}, "renders different objects each time"),
        ({"templates/wrong.yaml": "{{ fail .Release.Name }}"}, "templates/wrong.yaml"),
        ({"templates/namespace.yaml": "apiVersion: v1\nkind: Namespace\nmetadata: {name: x}\n"}, "v1/Namespace is not"),
    ],
    ids=["hook", "crd", "random", "error", "kind"],
)
def test_an_unusable_chart_is_rejected_with_a_reason_and_runs_once_corrected(
    api: Api, manager: Process, charts: Path, files: dict[str, str], logged: str
) -> None:
    wrong = write_chart(charts, "wrong", {**APPLICATION, **files})
    api.create(template("app", {"chart": str(wrong)}))
    api.create(demand("one", "app", "car1"))
    assert logged in wait_for_refusal(api, "app", "RenderFailed")
    assert api.find("Deployment", "app") is None
    right = {"spec": {"helm": {"chart": str(write_chart(charts, "right"))}}}
    api.patch("ApplicationTemplate", "app", right)
    wait_for_image(api, "app")


def test_hanging_chart_repositories_delay_no_other_template(api: Api, manager: Process, charts: Path) -> None:
    """Many templates whose repository accepts connections but never answers, then one valid template."""
    with silence() as url:
        for number in range(4):
            api.create(template(f"silent-{number}", {"chart": f"c{number}", "version": "1.0.0", "repository": url}))
            api.create(demand(f"silent-{number}", f"silent-{number}", "car1"))
        api.wait_list("ApplicationInstance", lambda found: len(found) == 4, what="all templates exist")
        api.create(template("app", {"chart": str(write_chart(charts, "app"))}))
        api.create(demand("one", "app", "car1"))
        wait_for_image(api, "app")
        api.wait_for(
            "ApplicationInstance",
            "silent-0",
            lambda raw: condition(raw, "Applied").get("status") == "False",
            what="one that waits for its chart reports it",
        )
        assert manager.terminate(patience=GRACE) == 0


def test_a_missing_chart_is_reported_and_a_path_outside_the_folder_is_rejected(api: Api, manager: Process) -> None:
    api.create(template("away", {"chart": "app", "version": "1.0.0", "repository": "http://127.0.0.1:1"}))
    api.create(template("outside", {"chart": "/etc"}))
    for name in ("away", "outside"):
        api.create(demand(name, name, "car1"))
    assert "cannot fetch chart app 1.0.0 of http://127.0.0.1:1" in wait_for_refusal(api, "away", "ChartUnavailable")
    assert "/etc is not in" in wait_for_refusal(api, "outside", "ChartUnavailable")
