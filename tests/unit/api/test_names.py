"""Encoded names can be read back, fit into keys, and keep subjects apart."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from wayside.names import decode, encode, parse_subject, subject_text

texts = st.text(st.characters(exclude_categories=["Cs"]), min_size=1)
subjects = st.tuples(st.lists(texts, max_size=3), st.none() | texts)


@given(texts)
def test_encoded_names_can_be_read_back(text: str) -> None:
    assert decode(encode(text)) == text


@given(texts)
def test_an_encoded_name_holds_only_safe_characters(text: str) -> None:
    assert re.fullmatch(r"(?:[A-Za-z0-9_.-]|%[0-9A-F]{2})+", encode(text))


@given(subjects, subjects)
def test_different_subjects_have_different_texts(
    one: tuple[list[str], str | None], other: tuple[list[str], str | None]
) -> None:
    assert (subject_text(*one) == subject_text(*other)) == (one == other)


def test_subjects_read_as_in_the_design() -> None:
    assert subject_text(["car1"]) == "car1"
    assert subject_text(["car1", "car2"], "north") == "car1+car2~north"
    assert subject_text([]) == "~fleet"
    assert subject_text([], "a/b") == "~fleet~a%2Fb"
    assert subject_text(["urn:car~1"]) == "urn%3Acar%7E1"


@given(subjects)
def test_a_subjects_text_contains_its_clients_and_element(subject: tuple[list[str], str | None]) -> None:
    clients, element = subject
    assert parse_subject(subject_text(clients, element)) == (tuple(clients), element)


@pytest.mark.parametrize("text", ["", "~", "~x", "~fleetx", "a+", "+", "a b", "a~b~c", "%zz", "%FF"])
def test_an_invalid_subject_is_rejected(text: str) -> None:
    with pytest.raises(ValueError, match=r"the subject must be|can't decode"):
        parse_subject(text)
