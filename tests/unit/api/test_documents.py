"""Every error of a file names file, line, column, field, value and remedy."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from wayside.api import Detector, EventRule
from wayside.api.documents import Document, DocumentError, Problem, load_documents, parse_object

HEAD = "apiVersion: wayside.dev/v1alpha1\nkind: EventRule\nmetadata: {name: r}\nspec:\n"
"""Four lines: what follows stands on the fifth."""

DETECTOR = "apiVersion: wayside.dev/v1alpha1\nkind: Detector\nmetadata: {name: d}\nspec:\n"


def problems(tmp_path: Path, text: str | bytes) -> list[str]:
    """The problems of a file with that text, without its folder."""
    file = tmp_path / "f.yaml"
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(DocumentError) as caught:
        load_documents([file])
    assert str(caught.value) == "\n".join(map(str, caught.value.problems))
    return [str(problem).removeprefix(f"{tmp_path}/") for problem in caught.value.problems]


@pytest.mark.parametrize("time", ["2026-02-30T00:00:00Z", "2026-01-01T25:00:00Z", "2026-13-01T00:00:00+01:00"])
def test_a_time_that_does_not_exist_is_rejected(time: str) -> None:
    raw = {"apiVersion": "wayside.dev/v1alpha1", "kind": "ApplicationTask", "metadata": {"name": "t"}}
    with pytest.raises(ValueError, match=rf"^spec\.endTime: must be a time; got '{re.escape(time)}'"):
        parse_object(raw | {"spec": {"templateName": "app", "endTime": time}})


def test_a_spec_beyond_its_bound_is_rejected_in_a_file_as_in_the_cluster(tmp_path: Path) -> None:
    (problem,) = problems(tmp_path, f"{HEAD}  when: '{'x' * 262_144}'\n")
    assert problem.startswith("f.yaml:5:3: spec: must have at most 262144 bytes as JSON; got 262")


@pytest.mark.parametrize("name", ["a.b", "A", "-a", "a" * 64])
def test_the_name_of_an_object_of_ours_is_a_label(tmp_path: Path, name: str) -> None:
    (problem,) = problems(tmp_path, f"{HEAD.replace('name: r', f'name: {name}')}  when: 'true'\n")
    assert problem.startswith("f.yaml:3:11: metadata: name must have at most 63 lower-case letters, digits and -")
    assert problem.endswith(f"; got {name!r}")


@pytest.mark.parametrize(
    ("text", "start", "parts"),
    [
        ('  when: "points" in a.streams', "f.yaml:5:18: is not YAML", ["quoted as a whole: '\"points\" in a.streams'"]),
        ("  when: 'a' == client", "f.yaml:5:", ["quoted as a whole: '''a'' == client'"]),
        ("  when: !ready", "f.yaml:5:9: spec.when: YAML reads !ready as a tag", ["quote the expression, '!ready'"]),
        ("  when: !a.b && c", "f.yaml:5:15: is not YAML", ["'!a.b && c'"]),
        ("  when: !(speed > 3)", "f.yaml:5:", ["quoted as a whole: '!(speed > 3)'"]),
        ("  when: !ready && !b", "f.yaml:5:", ["'!ready && !b'"]),
        ("  when: a ? b : c", "f.yaml:5:15: is not YAML", ["quoted as a whole: 'a ? b : c'"]),
        ("  when: [1, 2] == x", "f.yaml:5:", ["quoted as a whole: '[1, 2] == x'"]),
        ("  when: *x", "f.yaml:5:9: is not YAML", ["quoted as a whole: '*x'"]),
        ("  when: `x`", "f.yaml:5:9: is not YAML", ["quoted as a whole: '`x`'"]),
        ("  actions:\n  - {name: x, v: ${a.b}}", "f.yaml:6:", ["inside {…} and […], quote each string"]),
        ("  when: x\n\tuntil: y", "f.yaml:6:1: is not YAML", ["indent with spaces, not with tabs"]),
        ('  when: "x', "f.yaml:5:9: is not YAML", ["unexpected end of stream"]),
        ("  when: x\n until: y", "f.yaml:6:2: is not YAML", ["check the indentation and the quotes here"]),
        ('  when: "\x01"', "f.yaml:5:10: contains the character '\\x01'", ["remove it"]),
        ("  when: !!int abc", "f.yaml:5:9: spec.when: YAML cannot read 'abc' as int", ["put it in quotes"]),
        ("  when: !!python/object:os.system x", "f.yaml:5:9: spec.when: YAML cannot read 'x'", ["put it in quotes"]),
        ("  when: =", "f.yaml:5:9: spec.when: YAML cannot read '='", ["put it in quotes"]),
        (
            "  when: &a [*a]",
            "f.yaml:5:9: spec.when[0]: is nested more than 100 levels deep",
            ["a YAML alias that refers to itself"],
        ),
        ("  when: {a: 1}", "f.yaml:5:9: spec.when: must be a string; got {'a': 1}", ["put the whole value in quotes"]),
        ("  when: true", "f.yaml:5:9: spec.when: must be a string; got true", ["in quotes, as in 'true'"]),
        ("  when: 5", "f.yaml:5:9: spec.when: must be a string; got 5", ["in quotes"]),
        ("  when:", "f.yaml:5:8: spec.when: is empty", ["give it a value"]),
        ("  until: x", "f.yaml:5:3: spec.when: is missing", ["add it"]),
        ("  when: a\n  when: b", "f.yaml:6:3: spec.when: is given twice", ["remove one"]),
        ("  when: a\n  whem: b", "f.yaml:6:9: spec.whem: unknown field", ["did you mean when?"]),
        ("  when: a\n  colour: b", "f.yaml:6:11: spec.colour: unknown field", ["check its spelling"]),
        (
            "  when: a\n  actions:\n  - {name: x, deploy: {templateName: t, operations: Suspend}}",
            "f.yaml:7:53: spec.actions[0].deploy.operations: unknown field",
            ["did you mean operation?"],
        ),
        ("  when: a\n  for: 2", "f.yaml:6:8: spec.for: must be a string; got 2", []),
        ("  when: a\n  for: 2 s", "f.yaml:6:8: spec.for: must be a duration with units", ["such as 500ms, 10s"]),
        ("  when: a\n  evaluation: {every: 0s}", "f.yaml:6:15: spec.evaluation: every: must be 10ms or more", []),
        ("  when: a\n  enabled: maybe", "f.yaml:6:12: spec.enabled: must be true or false; got 'maybe'", []),
        (
            "  when: a\n  classification: {incidence: [Rare, Never]}",
            "f.yaml:6:38: spec.classification.incidence[1]: must be 'Frequent', 'Common', 'Rare' or 'Unexpected'",
            ["got 'Never'"],
        ),
        (
            "  when: a\n  signals:\n  - name: 9x\n    stream: s\n    value: v",
            "f.yaml:7:11: spec.signals[0].name: must be letters, digits and _, not beginning with a digit",
            ["got '9x'"],
        ),
        (
            "  when: a\n  signals:\n  - {name: x, stream: s, value: v, aggregate: Max}",
            "f.yaml:7:5: spec.signals[0]: aggregate Max needs a window",
            ["give over, e.g. over: 5s"],
        ),
        (
            "  when: a\n  signals:\n  - {name: x, stream: s, value: v}\n  - {name: x, stream: s, value: v}",
            "f.yaml:5:3: spec: signals: the name 'x' is used twice",
            ["unique"],
        ),
        (
            "  when: a\n  scope:\n    pairs: {position: {stream: s, x: a, y: b}, within: -3}",
            "f.yaml:7:56: spec.scope.pairs.within: must be greater than 0; got -3",
            [],
        ),
        (
            "  when: a\n  scope: {client: {}, pairs: {position: {stream: s, x: a, y: b}, within: 3}}",
            "f.yaml:6:10: spec.scope: give exactly one of client, pairs and fleet",
            [],
        ),
        ("  when: a\n  evaluation: {every: 5ms}", "f.yaml:6:15: spec.evaluation: every: must be 10ms or more", []),
        ("  - when", "f.yaml:5:3: spec: must be an object; got ['when']", []),
    ],
)
def test_a_problem_names_its_place_the_value_and_the_remedy(
    tmp_path: Path, text: str, start: str, parts: list[str]
) -> None:
    found = problems(tmp_path, HEAD + text + "\n")
    assert found[0].startswith(start), found
    assert all(part in found[0] for part in parts), found
    assert len(found) == 1


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("foo", "f.yaml:1:1: must be an object with apiVersion, kind, metadata and spec; got 'foo'"),
        (
            "apiVersion: v1\nkind: Pod",
            "f.yaml:1:1: must have apiVersion wayside.dev/v1alpha1 and one of the kinds EventRule, Detector, ",
        ),
        ("kind: EventRule", "f.yaml:1:1: must have apiVersion wayside.dev/v1alpha1"),
        (b"\xff\xfe\x00", "f.yaml: cannot be read: is not UTF-8 text"),
        (DETECTOR + "  streams: {}", "f.yaml:5:12: spec.streams: must be a valid list; got {}"),
        (
            DETECTOR + "  streams:\n  - {name: s, key: 'a/${client:*}', encoding: cdr}",
            "f.yaml:6:5: spec.streams[0]: type is required with encoding cdr: add it, e.g. geometry_msgs/msg/Pose",
        ),
        (
            DETECTOR + "  streams:\n  - {name: s, key: 'a/${client:*}', encoding: json, staleAfter: 3}",
            "f.yaml:6:65: spec.streams[0].staleAfter: must be a string; got 3",
        ),
        (
            DETECTOR + "  streams:\n  - {name: s, key: 'a/${client:*}', encoding: json, staleAfter: 0s}",
            "f.yaml:6:5: spec.streams[0]: staleAfter: must be a duration above zero, with units",
        ),
        (
            DETECTOR + "  clientTimeout: 0m\n  streams: [{name: s, key: a, client: c, encoding: json}]",
            "f.yaml:5:18: spec.clientTimeout: must be a duration above zero, with units",
        ),
        (
            DETECTOR + "  buffer: {bytes: 0Mi}\n  streams: [{name: s, key: a, client: c, encoding: json}]",
            "f.yaml:5:19: spec.buffer.bytes: must be a quantity above zero, such as 512Mi, 2G or 1e9; got '0Mi'",
        ),
        (
            DETECTOR + "  buffer: {bytes: 5 MB}\n  streams: [{name: s, key: a, client: c, encoding: json}]",
            "f.yaml:5:19: spec.buffer.bytes: must be a quantity above zero, such as 512Mi, 2G or 1e9; got '5 MB'",
        ),
        (
            DETECTOR + "  zenoh: {connect: ['zenoh:7447']}\n  streams: [{name: s, key: a, client: c, encoding: json}]",
            "f.yaml:5:21: spec.zenoh.connect[0]: must be protocol/address:port, e.g. tcp/zenoh:7447; got 'zeno",
        ),
    ],
)
def test_problems_of_other_files(tmp_path: Path, text: str | bytes, expected: str) -> None:
    (found,) = problems(tmp_path, text)
    assert found.startswith(expected)


def test_all_problems_of_all_files_are_reported_in_order(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(HEAD + "  whem: x\n---\n" + HEAD + "  when: 5\n")
    (tmp_path / "b.yml").write_text("a: 'x")
    (tmp_path / "good.yaml").write_text(HEAD + "  when: x\n")
    (tmp_path / "ignored.txt").write_text("{")
    with pytest.raises(DocumentError) as caught:
        load_documents([tmp_path, tmp_path / "none.yaml"])
    assert [(Path(p.file).name, p.line, p.field) for p in caught.value.problems] == [
        ("a.yaml", 5, "spec.when"),
        ("a.yaml", 5, "spec.whem"),
        ("a.yaml", 11, "spec.when"),
        ("b.yml", 1, ""),
        ("none.yaml", 0, ""),
    ]
    assert "there is no such file: check the path" in str(caught.value)


def test_a_folder_without_files_of_ours_is_reported(tmp_path: Path) -> None:
    with pytest.raises(DocumentError, match=r"the folder contains no \.yaml"):
        load_documents([tmp_path])


def test_several_documents_of_a_file_keep_the_places_of_their_fields(tmp_path: Path) -> None:
    file = tmp_path / "f.yaml"
    file.write_text(
        HEAD + "  when: a\n---\n---\n" + HEAD + "  signals:\n  - name: x\n    stream: s\n    value: v\n  when: b\n"
    )
    first, second = load_documents([file])
    assert isinstance(first, Document)
    assert isinstance(first.object, EventRule)
    assert (first.line, second.line) == (1, 8)
    problem = second.problem(("spec", "signals", 0, "value"), "x")
    assert str(problem) == f"{file}:15:12: spec.signals[0].value: x"
    absent = second.problem(("spec", "signals", 0, "where"), "x")
    assert (absent.line, absent.column) == (13, 5)


def test_json_with_tabs_and_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    text = (
        '{\n\t"apiVersion": "wayside.dev/v1alpha1",\n\t"kind": "EventRule",\n\t"metadata": {"name": "r"},\n\t"spec": '
    )
    (tmp_path / "a.json").write_text(text + '{"when": "a"}}')
    (tmp_path / "b.yaml").write_bytes(b"\xef\xbb\xbf" + (HEAD + "  when: a\n").encode())
    assert len(load_documents([tmp_path])) == 2


def test_times_and_yes_stay_text(tmp_path: Path) -> None:
    file = tmp_path / "f.yaml"
    file.write_text(
        "apiVersion: wayside.dev/v1alpha1\nkind: Detector\nmetadata: {name: d}\nspec:\n"
        "  clients: [{name: rsu, labels: {since: 2026-01-01T00:00:00Z}}]\n"
        "  zenoh: {scouting: yes}\n"
        "  streams: [{name: s, key: a, client: c, encoding: json}]\n"
    )
    (document,) = load_documents([file])
    assert isinstance(document.object, Detector)
    assert document.object.spec.clients[0].labels == {"since": "2026-01-01T00:00:00Z"}
    assert document.object.spec.zenoh.scouting is True


def test_yaml_alias_bombs_are_rejected(tmp_path: Path) -> None:
    lines = ["  a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"  a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 9)]
    (found,) = problems(tmp_path, HEAD + "\n".join(lines))
    assert "at most 200000 fields" in found


def test_an_object_of_the_api_server_is_reported_by_its_fields() -> None:
    raw: dict[str, Any] = {"apiVersion": "wayside.dev/v1alpha1", "kind": "EventRule", "metadata": {"name": "r"}}
    assert parse_object(raw | {"spec": {"when": "a"}}).name == "r"
    with pytest.raises(ValueError, match=r"spec\.when: is missing: add it; spec\.for: must be a duration"):
        parse_object(raw | {"spec": {"for": "2y"}})
    with pytest.raises(ValueError, match=r"must have apiVersion wayside\.dev/v1alpha1 and one of the kinds"):
        parse_object({"kind": "Pod"})


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)
fields = st.sampled_from(
    ["scope", "when", "until", "for", "signals", "actions", "evaluation", "classification", "enabled", "cooldown"]
)


def reported(file: Path) -> tuple[Problem, ...]:
    """The problems of a file; none where it is read. Nothing but DocumentError may be raised."""
    try:
        load_documents([file])
    except DocumentError as error:
        return error.problems or (Problem("", 0, 0, "", ""),)
    return ()


@settings(max_examples=150, deadline=None)
@given(st.dictionaries(fields, values, max_size=4) | values, st.booleans())
def test_any_file_is_read_or_its_problems_are_reported(
    tmp_path_factory: pytest.TempPathFactory, spec: Any, as_json: bool
) -> None:
    raw = {"apiVersion": "wayside.dev/v1alpha1", "kind": "EventRule", "metadata": {"name": "r"}, "spec": spec}
    file = tmp_path_factory.mktemp("any") / "f.yaml"
    file.write_text(json.dumps(raw) if as_json else yaml.safe_dump(raw, allow_unicode=True), encoding="utf-8")
    assert all(problem.line > 0 and problem.message for problem in reported(file))


@settings(max_examples=200, deadline=None)
@given(st.text(alphabet="abc: -[]{}!&*\"'#|>%@`\t\n\x01,?=<~1", max_size=40))
def test_any_line_raises_only_document_errors(tmp_path_factory: pytest.TempPathFactory, line: str) -> None:
    file = tmp_path_factory.mktemp("any") / "f.yaml"
    file.write_text(HEAD + "  when: " + line + "\n", encoding="utf-8")
    assert all(problem.line > 0 and problem.message for problem in reported(file))
