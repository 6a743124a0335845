"""Live configuration: a template's files become the texts of one ConfigMap of the instance."""

from __future__ import annotations

import copy
import json
from typing import Any

import pytest
import yaml
from pydantic import ValidationError

from application_manager.core.objects.policy import DEFAULT_KINDS, Policy
from application_manager.core.objects.rendering import Renderer, RenderError, Rendering
from tests.unit.manager_objects import DEPLOYMENT, instance, template

DECLARED = {"sources": {"type": "array", "items": "string", "merge": "Union"}, "rate": {"type": "number"}}


def render(files: dict[str, Any], policy: Policy | None = None, **values: Any) -> Rendering:
    spec = {"configuration": files, "parameters": DECLARED, "manifests": [_mounting()]}
    return Renderer(template(**spec), policy or Policy()).render(instance(parameters=values))


def _mounting() -> dict[str, Any]:
    manifest = copy.deepcopy(DEPLOYMENT)
    manifest["spec"]["template"]["spec"]["volumes"] = [
        {"name": "configuration", "configMap": {"name": "${instance.configMap}"}}
    ]
    return manifest


def refusal(files: dict[str, Any], **values: Any) -> str:
    with pytest.raises(RenderError) as caught:
        render(files, **values)
    return str(caught.value)


def files_of(rendering: Rendering) -> dict[str, str]:
    data: dict[str, str] = rendering.manifests[0]["data"]
    return data


def test_the_files_become_a_config_map_of_the_instance_which_its_manifests_can_name() -> None:
    config, deployment = render({"note.txt": "hello"}).manifests
    assert (config["kind"], config["metadata"]["name"]) == ("ConfigMap", "app-configuration")
    assert config["metadata"]["labels"]["wayside.dev/instance"] == "app"
    assert deployment["spec"]["template"]["spec"]["volumes"][0]["configMap"] == {"name": "app-configuration"}


def test_a_map_or_list_is_written_in_the_format_of_the_extension() -> None:
    content = {"sources": "${parameters.sources}", "rate": "${parameters.rate}"}
    files = files_of(render({"a.yaml": content, "b.yml": content, "c.json": content}, sources=["n", "2"], rate=5.0))
    expected = {"sources": ["n", "2"], "rate": 5}
    assert yaml.safe_load(files["a.yaml"]) == yaml.safe_load(files["b.yml"]) == json.loads(files["c.json"]) == expected
    assert "rate: 5\n" in files["a.yaml"]


def test_a_text_stays_as_it_is_whatever_the_extension() -> None:
    files = files_of(render({"a.json": "rate ${parameters.rate}\n", "run": 'cd "$${HOME}"'}, rate=5.0))
    assert files == {"a.json": "rate 5\n", "run": 'cd "${HOME}"'}


def test_a_number_needs_no_format_and_a_null_file_is_omitted() -> None:
    assert files_of(render({"rate": "${parameters.rate}"}, rate=5.0)) == {"rate": "5"}
    assert files_of(render({"rate": "${parameters.rate}", "other": "x"})) == {"other": "x"}


def test_a_changed_configuration_changes_only_its_config_map() -> None:
    one, other = (render({"a.yaml": {"sources": "${parameters.sources}"}}, sources=each) for each in (["a"], ["b"]))
    assert one.manifests[0] != other.manifests[0]
    assert one.manifests[1:] == other.manifests[1:]


def test_a_list_in_a_file_without_a_format_is_refused_with_the_remedy() -> None:
    assert refusal({"sources.txt": "${parameters.sources}"}, sources=["a"]) == (
        "spec.configuration.sources.txt: is a list, but the file name gives no format: end the name with .yaml or "
        ".json, or give a string"
    )


def test_all_wrong_expressions_are_named_with_their_files() -> None:
    with pytest.raises(RenderError) as caught:
        render({"a.yaml": {"x": "${parameters.rat}"}, "b.yaml": ["${nothing}"]})
    first, second = caught.value.problems
    assert first.startswith("spec.configuration.a.yaml.x")
    assert "`parameters.rat` does not exist" in first
    assert second.startswith("spec.configuration.b.yaml[0]")


def test_a_file_whose_value_fails_is_named() -> None:
    assert "spec.configuration.a.txt" in refusal({"a.txt": "rate: ${parameters.rate}"})


def test_without_a_configuration_the_config_map_name_is_undefined() -> None:
    with pytest.raises(RenderError, match=r"`instance\.configMap` does not exist"):
        Renderer(template(parameters=DECLARED, manifests=[_mounting()]), Policy())


def test_files_that_do_not_fit_a_config_map_are_rejected() -> None:
    assert "spec.configuration: the files have 1200003 bytes" in refusal({"a.b": "é" * 600_000})


def test_a_configuration_is_rejected_if_config_maps_are_not_allowed() -> None:
    policy = Policy(DEFAULT_KINDS - {("v1", "ConfigMap")})
    with pytest.raises(RenderError, match="becomes a ConfigMap, but v1/ConfigMap is not a kind"):
        render({"a": "b"}, policy)


def test_a_manifest_of_the_same_name_is_refused() -> None:
    own = {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "${instance.configMap}"}}
    with pytest.raises(RenderError, match="ConfigMap 'app-configuration' is given twice"):
        Renderer(template(configuration={"a": "b"}, manifests=[own]), Policy()).render(instance())


def test_an_invalid_file_name_is_rejected() -> None:
    with pytest.raises(ValidationError, match="String should match pattern"):
        template(configuration={"a/b": "c"})
