"""Actions of installed packages are found and get their parameters; errors are reported by field."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, ClassVar

import pytest
from pydantic import BaseModel, ConfigDict, Field

from detector.actions import Action
from detector.actions.registry import OFFERS, action_problems, prepare_action
from detector.assembly import RuleIndex, stream_readers
from detector.assembly.checking import findings
from detector.plugins import entrypoints
from tests.driving import a_detector, a_rule
from wayside.api.documents import load_documents


class LampParameters(BaseModel):
    model_config = ConfigDict(extra="forbid")

    colour: str
    seconds: float = Field(default=1, gt=0)


class Lamp(Action[LampParameters]):
    """Switches a lamp on."""

    Parameters: ClassVar[type[BaseModel]] = LampParameters


class WithoutModel(Action[Any]):
    """Has no model of its parameters."""


@pytest.fixture(autouse=True)
def packages(monkeypatch: pytest.MonkeyPatch) -> None:
    """The classes above as installed actions."""
    here = [
        EntryPoint(name, f"{__name__}:{value}", OFFERS.group)
        for name, value in (
            ("lamp", "Lamp"),
            ("bare", "WithoutModel"),
            ("parameters", "LampParameters"),
            ("lost", "Absent"),
        )
    ]
    monkeypatch.setattr(entrypoints, "entry_points", lambda group: here)
    entrypoints._load.cache_clear()


def rule(name: str, **parameters: Any) -> Any:
    return a_rule(when="true", actions=[{"name": "a", "plugin": {"name": name, "parameters": parameters}}])


def test_an_action_gets_its_parameters_as_its_model() -> None:
    (action,) = rule("lamp", colour="red").spec.actions
    assert prepare_action(action) == (Lamp, LampParameters(colour="red"))


@pytest.mark.parametrize(
    ("name", "parameters", "problem"),
    [
        ("lamb", {}, "plugin.name: no action lamb is installed; did you mean lamp? (docs/actions.md)"),
        ("xyz", {}, "plugin.name: no action xyz is installed; there are bare, lamp, lost, parameters"),
        ("lost", {}, "plugin.name: cannot load action lost: AttributeError"),
        ("parameters", {}, "must be a complete subclass of detector.actions.base.Action; got "),
        (
            "bare",
            {},
            "plugin.name: action bare: give tests.unit.actions.test_actions_registry:WithoutModel a class Parameters",
        ),
        (
            "deploy",
            {},
            "plugin.name: deploy is a built-in action, not a plugin: write deploy: {…} instead of plugin: {…}",
        ),
        ("lamp", {}, "plugin.parameters.colour: is missing: add it"),
        ("lamp", {"colour": "red", "seconds": 0}, "plugin.parameters.seconds: must be greater than 0; got 0"),
        ("lamp", {"colour": "red", "color": "red"}, "plugin.parameters.color: unknown field"),
    ],
)
def test_errors_of_an_action_are_reported_by_field(name: str, parameters: dict[str, Any], problem: str) -> None:
    (found,) = action_problems(rule(name, **parameters), a_detector())
    assert problem in str(found)
    assert str(found).startswith("spec.actions[0].plugin.")


def test_check_reports_line_and_column(tmp_path: Path) -> None:
    (tmp_path / "d.json").write_text(a_detector().model_dump_json(by_alias=True, exclude_none=True))
    (tmp_path / "r.yaml").write_text(
        "apiVersion: wayside.dev/v1alpha1\nkind: EventRule\nmetadata: {name: r}\nspec:\n  when: 'true'\n"
        "  actions:\n    - name: a\n      plugin: {name: lamp, parameters: {colour: 3}}\n"
    )
    (problem,) = findings(load_documents([tmp_path])).problems
    assert "r.yaml:8:49: spec.actions[0].plugin.parameters.colour: must be a string; got 3" in str(problem)


def test_a_rule_whose_action_is_rejected_keeps_its_last_good_version() -> None:
    index, detector = RuleIndex(), a_detector()
    index.compile([rule("lamp", colour="red")], detector, stream_readers(detector).fields)
    (kept,), (refusal,) = index.compile([rule("lamp")], detector, stream_readers(detector).fields)
    assert kept.name == "r"
    assert refusal.kept
    assert "plugin.parameters.colour" in str(refusal)


def test_a_built_in_action_wins_over_a_package_with_the_same_name(monkeypatch: pytest.MonkeyPatch) -> None:
    own = [EntryPoint("lamp", "detector.actions:Action", OFFERS.group)]
    monkeypatch.setattr(entrypoints, "_foreign", lambda entry: entry not in own)
    others = entrypoints.entry_points(group=OFFERS.group)
    monkeypatch.setattr(entrypoints, "entry_points", lambda group: [*others, *own])
    assert OFFERS.installed()["lamp"] == own[0]
