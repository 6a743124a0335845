"""A Detector and its rules from files: selection, skipped rules, and errors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from detector.resources.files import load_rules
from wayside.api.documents import DocumentError

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def to(name: str, *objects: dict[str, Any]) -> Path:
        file = tmp_path / name
        file.write_text(yaml.safe_dump_all(objects))
        return file

    return to


def detector(name: str = "d", **spec: Any) -> dict[str, Any]:
    streams = [{"name": "pose", "key": "vehicles/${client:*}/pose", "encoding": "json"}]
    return made("Detector", name, {}, {"streams": streams, **spec})


def rule(name: str, **labels: str) -> dict[str, Any]:
    return made("EventRule", name, labels, {"when": "true"})


def made(kind: str, name: str, labels: dict[str, str], spec: dict[str, Any]) -> dict[str, Any]:
    metadata: dict[str, Any] = {"name": name, "labels": labels}
    return {"apiVersion": "wayside.dev/v1alpha1", "kind": kind, "metadata": metadata, "spec": spec}


def test_rules_come_by_name_from_all_files(write: Write) -> None:
    loaded = load_rules(
        write("d.yaml", detector()), [write("1.yaml", rule("b"), rule("c")), write("2.yaml", rule("a"))]
    )
    assert [each.name for each in loaded.rule_set.rules] == ["a", "b", "c"]
    assert loaded.rules["c"].file.endswith("1.yaml")
    assert loaded.warnings == ()


def test_a_folder_may_contain_the_detector_and_all_rules(write: Write, tmp_path: Path) -> None:
    template = made("ApplicationTemplate", "t", {}, {"manifests": [{"apiVersion": "v1", "kind": "ConfigMap"}]})
    write("all.yaml", detector(), rule("a"), template)
    loaded = load_rules(tmp_path, [tmp_path])
    assert loaded.rule_set.detector.name == "d"
    assert [each.name for each in loaded.rule_set.rules] == ["a"]


def test_a_rule_that_the_detector_does_not_select_is_left_out_and_reported(write: Write) -> None:
    selecting = detector(ruleSelector={"matchLabels": {"site": "a"}})
    loaded = load_rules(write("d.yaml", selecting), [write("r.yaml", rule("in", site="a"), rule("out", site="b"))])
    assert [each.name for each in loaded.rule_set.rules] == ["in"]
    [warning] = loaded.warnings
    assert "r.yaml:" in warning
    assert "'out' is not evaluated" in warning
    assert "selects by labels: site=a: correct metadata.labels" in warning


def test_a_rule_of_another_namespace_is_left_out_and_reported(write: Write) -> None:
    elsewhere = rule("out")
    elsewhere["metadata"]["namespace"] = "elsewhere"
    loaded = load_rules(write("d.yaml", detector()), [write("r.yaml", elsewhere)])
    assert loaded.rule_set.rules == ()
    assert "of its own namespace" in loaded.warnings[0]


def test_a_folder_with_no_or_two_detectors_is_rejected(write: Write) -> None:
    rules = [write("r.yaml", rule("a"))]
    with pytest.raises(DocumentError, match="contains no Detector: give one"):
        load_rules(write("none.yaml", rule("a")), rules)
    with pytest.raises(DocumentError, match=r"two\.yaml:\d+:\d+: metadata\.name: is a second Detector"):
        load_rules(write("two.yaml", detector("d"), detector("e")), rules)


def test_two_rules_of_the_same_name_are_rejected_with_both_places(write: Write) -> None:
    with pytest.raises(DocumentError, match=r"2\.yaml:.*'a' is also in .*1\.yaml:1: rename or remove one"):
        load_rules(write("d.yaml", detector()), [write("1.yaml", rule("a")), write("2.yaml", rule("a"))])


def test_all_problems_come_at_once_and_each_once(write: Write) -> None:
    broken = write("broken.yaml", made("EventRule", "x", {}, {"wen": "true"}))
    with pytest.raises(DocumentError) as caught:
        load_rules(broken, [broken, "/nowhere/rules.yaml"])
    fields = [problem.field for problem in caught.value.problems]
    assert fields.count("spec.wen") == 1
    assert fields.count("spec.when") == 1
    assert any("no such file" in problem.message for problem in caught.value.problems)


def test_an_invalid_client_name_is_reported_with_the_valid_form(write: Write) -> None:
    stream = {"name": "cam", "key": "all/cams", "encoding": "json", "client": "a b"}
    with pytest.raises(
        DocumentError, match=r"must be a name of up to 63 letters, .* or a template such as its-"
    ) as reported:
        load_rules(write("d.yaml", detector(streams=[stream])), [])
    assert "got 'a b'" in str(reported.value)
