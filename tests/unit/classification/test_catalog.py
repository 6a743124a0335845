"""The catalog: rules by dimension and value, as a table, Markdown, JSON and a page of its own."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from detector.commands.catalog.catalog import Catalog, CatalogEntry, ChoiceError, catalog, choose
from detector.commands.catalog.views import markdown_view, page
from detector.commands.cli import app
from wayside.api.classification import SCHEME, Classification
from wayside.api.documents import DocumentError
from wayside.kubernetes.connection import ConfigurationError
from wayside.process import commandline

HOSTILE = "</script><b>x</b> | `a` **b** \"'&\n## heading"
ACTIONS = next(dimension for dimension in SCHEME if dimension.name == "typeOfAction")


def an_entry(name: str, place: str = "rules.yaml:1", description: str = "", **values: list[str]) -> CatalogEntry:
    return CatalogEntry(name, place, description, Classification.model_validate(values))


def names(entries: tuple[CatalogEntry, ...]) -> list[str]:
    return [each.name for each in entries]


SHADOW = an_entry("shadow", typeOfAction=["DataCollection"], incidence=["Common"])
BATTERY = an_entry("battery", typeOfAction=["Notification"], incidence=["Rare"], actingEntity=["External"])
BOTH = an_entry("both", typeOfAction=["Notification", "DataCollection"])
PLAIN = an_entry("plain")
ALL = (SHADOW, BATTERY, BOTH, PLAIN)

CLASSIFICATIONS = st.fixed_dictionaries(
    {
        dimension.name: st.lists(st.sampled_from([value.value for value in dimension.values]), unique=True)
        for dimension in SCHEME
    }
)


@given(st.lists(CLASSIFICATIONS, max_size=4))
def test_a_rule_is_listed_at_its_values_and_at_no_other(given_values: list[dict[str, list[str]]]) -> None:
    entries = [an_entry(f"r{index}", **values) for index, values in enumerate(given_values)]
    found = catalog(entries)
    for dimension in SCHEME:
        for value in dimension.values:
            wanted = [
                each for each, values in zip(entries, given_values, strict=True) if value in values[dimension.name]
            ]
            assert list(found.having(value)) == wanted, (dimension.name, value)
    assert names(found.unclassified) == [
        each.name for each, values in zip(entries, given_values, strict=True) if not any(values.values())
    ]


def test_the_same_word_in_two_dimensions_is_two_values() -> None:
    found = catalog([BATTERY])
    external = {d.name: names(found.having(v)) for d in SCHEME for v in d.values if v.value == "External"}
    assert external.pop("actingEntity") == ["battery"]
    assert len(external) == 3
    assert not any(external.values())


def test_values_of_one_dimension_are_alternatives_and_dimensions_are_combined() -> None:
    def left(*only: str) -> list[str]:
        return names(catalog(ALL, choose(only)).entries)

    assert left("typeOfAction=DataCollection") == ["both", "shadow"]
    assert left("typeOfAction=DataCollection", "typeOfAction=Notification") == ["battery", "both", "shadow"]
    assert left("typeOfAction=DataCollection", "incidence=Common") == ["shadow"]
    assert left("incidence=Unexpected") == []


@pytest.mark.parametrize(
    ("text", "shows"),
    [
        ("purpose=Safety", "unknown dimension 'purpose'; the dimensions are overarchingPurpose, typeOfParticipants"),
        ("incidence=Often", "incidence has no value 'Often'; its values are Frequent, Common, Rare, Unexpected"),
        ("incidence", "incidence has no value ''; its values are Frequent"),
    ],
)
def test_unknown_dimensions_and_values_are_rejected_with_the_known_ones(text: str, shows: str) -> None:
    with pytest.raises(ChoiceError, match=shows):
        choose([text])


def test_rules_of_the_same_name_are_distinguished_by_their_source() -> None:
    one, other = an_entry("r", "examples/a/rules.yaml:3"), an_entry("r", "examples/b/rules.yaml:3")
    labels = catalog([other, one, BATTERY]).labels()
    assert [labels[one], labels[other], labels[BATTERY]] == ["r (a/rules.yaml:3)", "r (b/rules.yaml:3)", "battery"]


class Page(HTMLParser):
    """The elements and texts of a page, and the URLs that it would fetch."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.fetched: list[str] = []
        self.text = ""
        self.articles: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        values = dict(attrs)
        self.fetched += [f"{tag} {values[name]}" for name in ("src", "href") if name in values]
        if tag == "article":
            self.articles.append(values["data-values"] or "")

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_page_has_all_rules_with_their_values_and_fetches_nothing() -> None:
    seen = Page(page(catalog(ALL)))
    assert seen.tags.count("button") == 39
    assert sorted(seen.articles) == [
        "",
        "actingEntity.External incidence.Rare typeOfAction.Notification",
        "incidence.Common typeOfAction.DataCollection",
        "typeOfAction.DataCollection typeOfAction.Notification",
    ]
    assert seen.fetched
    assert all(each.startswith("a #rule-") for each in seen.fetched)
    assert "It has no classification." in seen.text


def test_texts_of_rules_are_text_on_the_page_and_in_markdown() -> None:
    calm = an_entry("r", "p", "words", incidence=["Rare"])
    hostile = an_entry("r", HOSTILE, HOSTILE, incidence=["Rare"])
    assert Page(page(Catalog((hostile,)))).tags == Page(page(Catalog((calm,)))).tags
    assert HOSTILE in Page(page(Catalog((hostile,)))).text
    assert markdown_view(Catalog((hostile,))).count("\n") == markdown_view(Catalog((calm,))).count("\n")
    assert r"\</script\>\<b\>x\</b\> \| \`a\` \*\*b\*\*" in markdown_view(Catalog((hostile,)))


def test_the_markdown_has_the_scheme_and_a_table_for_each_classified_rule() -> None:
    lines = markdown_view(catalog(ALL)).splitlines()
    assert [line for line in lines if line.startswith("## ")] == ["## battery", "## both", "## shadow"]
    assert "| **Type of Action** | data collection | both, shadow |" in lines
    assert "| | *not given* | both |" in lines
    assert "Without classification: plain." in lines
    assert "| Type of Action | data collection, notification |" in lines


def a_rule(name: str, classification: dict[str, list[str]] | None) -> str:
    spec = {"when": "true", **({"classification": classification} if classification else {})}
    return yaml.safe_dump(
        {"apiVersion": "wayside.dev/v1alpha1", "kind": "EventRule", "metadata": {"name": name}, "spec": spec}
    )


@pytest.fixture
def rules(tmp_path: Path) -> Path:
    folder = tmp_path / "rules"
    folder.mkdir()
    (folder / "a.yaml").write_text(a_rule("battery", {"incidence": ["Rare"], "typeOfAction": ["Notification"]}))
    (folder / "b.yaml").write_text(a_rule("shadow", {"incidence": ["Common"]}) + "---\n" + a_rule("plain", None))
    return folder


def run(*arguments: str) -> int:
    return commandline.run_cli(app, "detector", (DocumentError, ConfigurationError, OSError), ["catalog", *arguments])


def test_the_command_prints_a_table_of_all_values(rules: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(str(rules)) == 0
    reported = capsys.readouterr()
    lines = [line.rstrip() for line in reported.out.splitlines()]
    assert lines[0].split() == ["DIMENSION", "VALUE", "RULES"]
    assert sum(line.endswith("rare                    battery") for line in lines) == 1
    assert lines[-1] == "without classification: plain"
    assert reported.err == "3 of 3 rules\n"


def test_the_command_writes_json_for_other_programs(rules: Path, tmp_path: Path) -> None:
    output = tmp_path / "catalog.json"
    assert run(str(rules), "--format", "json", "--output", str(output)) == 0
    document = json.loads(output.read_text())
    assert [each["name"] for each in document["rules"]] == ["battery", "plain", "shadow"]
    assert document["rules"][0]["classification"] == {"incidence": ["Rare"], "typeOfAction": ["Notification"]}
    assert document["rules"][0]["place"] == f"{rules / 'a.yaml'}:1"
    assert "classification" not in document["rules"][1]
    incidence = next(each for each in document["dimensions"] if each["name"] == "incidence")
    assert {each["name"]: each["rules"] for each in incidence["values"]} == {
        "Frequent": [], "Common": [2], "Rare": [0], "Unexpected": [],
    }  # fmt: skip
    assert all(value["definition"] for each in document["dimensions"] for value in each["values"])


@pytest.mark.parametrize(
    ("arguments", "shows"),
    [
        ([], "give files or folders with EventRules, or --cluster"),
        (["x.yaml", "--cluster"], "give files or folders with EventRules, or --cluster"),
        (["x.yaml", "--namespace", "n"], "--namespace requires --cluster"),
        (["x.yaml"], "x.yaml: there is no such file"),
        (["x.yaml", "--only", "incidence=Often"], "--only incidence=Often: incidence has no value 'Often'"),
        (["x.yaml", "--format", "pdf"], "'pdf' is not one of"),
    ],
)
def test_a_usage_error_of_catalog_is_one_line(
    arguments: list[str], shows: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*arguments) == 2
    reported = capsys.readouterr().err
    assert shows in reported
    assert reported.count("\n") == 1


def test_without_an_api_server_the_alternatives_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "nowhere"))
    assert run("--cluster") == 2
    reported = capsys.readouterr().err
    assert "there is no such file" in reported
    assert "give either files or folders with EventRules, or --cluster" in reported
    assert "--detector" not in reported
