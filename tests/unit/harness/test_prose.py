"""The check of retired phrases and names finds them in text and in identifiers, and nothing else."""

from __future__ import annotations

import pytest

from tests.prose import RETIRED, RETIRED_NAMES, findings, name_findings


@pytest.mark.parametrize("text", ["it is told", "so many samples", "test_it_is_told", "def soMany(): ...", "SoMany"])
def test_a_retired_phrase_is_found_in_text_and_in_identifiers(text: str) -> None:
    [(line, _, suggestion)] = findings(f"plain words\n{text}\n")
    assert line == 2
    assert suggestion in RETIRED.values()


def test_other_words_that_contain_a_retired_phrase_are_not_found() -> None:
    assert list(findings("the notebook, the newsletter and essays; sessions_saidar")) == []


@pytest.mark.parametrize("name", ["Courier", "WeatherAspect", "_tallies", "open_desk", "DESKS"])
def test_a_retired_name_is_found_in_identifiers(name: str) -> None:
    [(line, found, suggestion)] = name_findings(f"x = 1\nself.{name} = x\n")
    assert (line, found) == (2, name)
    assert suggestion in RETIRED_NAMES.values()


def test_a_retired_name_may_occur_in_texts_and_within_other_words() -> None:
    assert list(name_findings('"""A courier."""  # the desk\noversight = outstanding = "tally"\n')) == []
