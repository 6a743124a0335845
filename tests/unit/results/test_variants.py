"""Variants of rules: played in one pass, compared with the rule as written."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from detector.commands.replay import replay_files
from detector.replay.variants import VariantError, variants_of, with_variants
from tests.unit.results.drives import documents, write
from wayside.api import Detector


def started(folder: Path, rule: str) -> list[str]:
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    return [e["data"]["startTime"] for e in events if e["data"]["rule"] == rule and e["type"].endswith("started")]


def test_a_sweep_evaluates_all_values_in_one_pass_as_if_written_separately(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording, detector, rules = write(tmp_path)
    plain, swept = tmp_path / "plain", tmp_path / "swept"
    replay_files([recording], plain, detector, [rules], as_one=False)
    replay_files([recording], swept, detector, [rules], as_one=False, sweeps=["too-fast.parameters.limit=19:23:2"])
    for name in ("events.jsonl", "tasks.yaml"):
        assert (swept / name).read_bytes() == (plain / name).read_bytes()
    found = json.loads((swept / "variants.json").read_text())
    assert [each["variant"] for each in found] == [f"parameters.limit={limit}" for limit in (19, 21, 23)]
    for each, limit in zip(found, (19, 21, 23), strict=True):
        rules.write_text(rules.read_text().replace("limit: 21", f"limit: {limit}"))
        replay_files([recording], tmp_path / str(limit), detector, [rules], as_one=False)
        rules.write_text(rules.read_text().replace(f"limit: {limit}", "limit: 21"))
        own = sorted(each["onlySecond"], key=str) + [pair["second"] for pair in each["both"]]
        assert sorted(span["startTime"] for span in own) == sorted(started(tmp_path / str(limit), "too-fast"))
    assert found[1]["onlyFirst"] == found[1]["onlySecond"] == []
    assert found[1]["agreement"] == 1
    lines = capsys.readouterr().err.splitlines()
    row = next(line for line in lines if "parameters.limit=21" in line)
    assert row.split()[1:] == ["13", "13", "+0", "-0", "+0.00", "s", "100.0%"]


def test_several_set_fields_make_one_variant(tmp_path: Path) -> None:
    _, rules = documents(tmp_path)
    (variant,) = variants_of(rules, ["harsh.when=fastest - speed > 2", "harsh.signals.fastest.over=2s"], [])
    assert variant.rule.name == "harsh-1"
    assert variant.rule.spec.when == "fastest - speed > 2"
    assert variant.rule.spec.signals[1].over is not None
    assert variant.label == "when=fastest - speed > 2, signals.fastest.over=2s"
    assert rules[1].spec.when == "fastest - speed > 1.5"


def test_a_sweep_takes_a_range_with_both_ends_or_a_list(tmp_path: Path) -> None:
    _, rules = documents(tmp_path)

    def limits(text: str) -> list[object]:
        found = variants_of(rules, [], [f"too-fast.parameters.limit={text}"])
        return [each.rule.spec.parameters["limit"] for each in found]

    assert limits("80:200:40") == [80, 120, 160, 200]
    assert limits("0:0.3:0.1") == [0, 0.1, 0.2, 0.3]
    assert limits("5,7.5") == [5, 7.5]


def test_client_parameters_apply_to_variants_that_do_not_set_them(tmp_path: Path) -> None:
    detector, rules = documents(tmp_path)
    document = detector.model_dump(mode="json", by_alias=True, exclude_unset=True)
    document["spec"]["clients"] = [{"name": "car1", "parameters": {"too-fast": {"limit": 15}}}]
    detector = Detector.model_validate(document)
    variants = variants_of(rules, ["too-fast.until=speed < 14"], ["too-fast.parameters.limit=19"])
    (client,) = with_variants(detector, variants).spec.clients
    assert client.parameters == {"too-fast": {"limit": 15}, "too-fast-1": {"limit": 15}}


@pytest.mark.parametrize(
    ("sets", "sweeps", "words"),
    [
        (["close"], [], "--set must be RULE.FIELD=VALUE"),
        (["clos.when=true"], [], "there is no rule clos; did you mean close?"),
        ([], ["too-fast.parameters.limits=1:2:1"], "rule too-fast has no parameter limits; it has area, limit"),
        ([], ["too-fast.parameters.limit=3:1:1"], "last not below first"),
        ([], ["too-fast.parameters.limit=1:2:0"], "with step above 0"),
        ([], ["too-fast.parameters.limit=0:1000:1"], "--sweep may give at most 100 variants; got 1001"),
        (["harsh.signals.slowest.over=1s"], [], "there is no slowest; the names are speed, fastest"),
        (["harsh.signals.speed.over=x"], [], "harsh with signals.speed.over=x: spec.signals.0.over"),
    ],
)
def test_a_field_that_cannot_be_varied_is_an_error_with_the_reason(
    tmp_path: Path, sets: list[str], sweeps: list[str], words: str
) -> None:
    _, rules = documents(tmp_path)
    with pytest.raises(VariantError) as caught:
        variants_of(rules, sets, sweeps)
    assert words in str(caught.value)
