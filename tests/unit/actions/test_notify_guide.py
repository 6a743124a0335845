"""The rule in docs/notify.md is valid, and errors of a notify action are reported with their place."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from detector.actions.notify import Notify
from detector.assembly.checking import findings
from tests.driving import a_detector
from tests.guides import guide, yaml_blocks
from wayside.api.actions.notify import NotifyAction as Parameters
from wayside.api.documents import DocumentError, load_documents

GUIDE = guide("notify")
HEAD = "apiVersion: wayside.dev/v1alpha1\nkind: EventRule\nmetadata: {name: r}\nspec:\n"
SIGNAL = "  signals: [{name: v, stream: speed, value: msg.v}]\n  when: v > 1\n  actions:\n    - name: a\n      notify: "


def problems(folder: Path, rule: str) -> list[str]:
    (folder / "d.json").write_text(a_detector().model_dump_json(by_alias=True, exclude_none=True))
    (folder / "r.yaml").write_text(rule)
    try:
        found = findings(load_documents([folder])).problems
    except DocumentError as error:
        found = [*error.problems]
    return [str(each).removeprefix(f"{folder}/") for each in found]


def test_the_guides_rule_has_no_findings(tmp_path: Path) -> None:
    (example,) = yaml_blocks(GUIDE)
    assert len(yaml.safe_load(example)["actions"]) == 3
    assert problems(tmp_path, HEAD + "".join(f"  {line}\n" for line in example.splitlines())) == []


def test_the_built_in_action_gets_the_settings_of_the_rule() -> None:
    assert Notify.Parameters is Parameters


@pytest.mark.parametrize(
    ("notify", "reported"),
    [
        (
            "{zenoh: {key: a}, title: '${clint}'}",
            "r.yaml:9:40: spec.actions[0].notify.title: title, line 1, column 3: ",
        ),
        (
            "{zenoh: {key: a}, labels: {x: '${v +}'}}",
            "spec.actions[0].notify.labels: labels.x, line 1, column 6",
        ),
        ("{zenoh: {key: 'a/**'}}", "spec.actions[0].notify.zenoh.key: must be a Zenoh key without wildcards"),
        ("{}", "give exactly one of http, alertmanager and zenoh"),
        ("{zenoh: {key: a}, http: {url: 'http://a'}}", "give exactly one of http, alertmanager and zenoh"),
        ("{http: {}}", "give exactly one of url and urlSecretKeyRef"),
        ("{http: {url: 'ftp://a'}}", "spec.actions[0].notify.http.url: must be a URL such as https://host:port/path"),
        ("{http: {url: 'http://ann:pass@a/'}}", "use credentialsSecretName"),
        ("{zenoh: {key: a}, labels: {a: b}, grouping: {by: [c]}}", "grouping.by refers to a label"),
        ("{alertmanager: {url: 'http://a'}, grouping: {}}", "an Alertmanager groups alerts itself"),
        ("{alertmanager: {url: 'http://a'}, events: [Started]}", "an Alertmanager groups alerts itself"),
        ("{zenoh: {key: a}, events: [Begun]}", "spec.actions[0].notify.events[0]"),
        ("{zenoh: {key: a}, rate: {messages: 0}}", "spec.actions[0].notify.rate.messages"),
    ],
)
def test_errors_are_reported_by_field(tmp_path: Path, notify: str, reported: str) -> None:
    found = problems(tmp_path, HEAD + SIGNAL + notify + "\n")
    assert len(found) == 1, found
    assert found[0].startswith("r.yaml:9:")
    assert reported in found[0]
