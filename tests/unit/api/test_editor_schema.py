"""`detector schema`: valid files pass, a misspelt field does not."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from jsonschema import Draft7Validator
from typer.testing import CliRunner

from detector.commands.cli import app
from tests.guides import ROOT

FILES = sorted((ROOT / "examples").glob("*/*.yaml"))


@pytest.fixture(scope="module")
def validator(tmp_path_factory: pytest.TempPathFactory) -> Draft7Validator:
    path = tmp_path_factory.mktemp("schema") / "wayside.schema.json"
    assert CliRunner().invoke(app, ["schema", "--output", str(path)]).exit_code == 0
    schema = json.loads(path.read_text())
    Draft7Validator.check_schema(schema)
    return Draft7Validator(schema)


@pytest.mark.parametrize("file", FILES, ids=lambda file: f"{file.parent.name}/{file.name}")
def test_the_examples_are_right_by_the_schema(file: Path, validator: Draft7Validator) -> None:
    for document in yaml.safe_load_all(file.read_text()):
        assert [error.message for error in validator.iter_errors(document)] == []


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("  when:", "  wen:", "wen"),
        ("kind: EventRule", "kind: EventRules", "EventRules"),
        ("every: 500ms", "every: often", "often"),
        ("scope:", "scoop:", "scoop"),
    ],
)
def test_misspelt_fields_are_found(old: str, new: str, word: str, validator: Draft7Validator) -> None:
    text = (ROOT / "examples/cooperative-recording/rules.yaml").read_text()
    assert old in text
    errors = [*validator.iter_errors(yaml.safe_load(text.replace(old, new)))]
    assert any(word in error.message for error in errors)
