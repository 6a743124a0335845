"""Fields of JSON are read as the decoder of whole messages reads them, whatever the payloads are."""

from collections.abc import Sequence
from random import Random
from typing import Any

import pytest

from detector.engine.samples.sample import MISSING, FieldDecoder
from detector.streams.codecs import CborDecoder, JsonDecoder, RawDecoder
from detector.streams.codecs.json_ import MAX_DEPTH
from tests.unit.encodings import hostile
from tests.unit.encodings.whole_messages import Path, assert_reads_as_decoded

NAMES = ["a", "b", "c", "é", ""]
NUMBERS = [b"1", b"-0", b"0.5", b"-1e3", b"9007199254740993", b"1" * 30, b"1e-400", b"0e9999"]
TEXTS = [b'"text"', '"é"'.encode(), b'"car-e1234"', b'"3e1000"', b'"[{"', rb'"\"]"', rb'"\\"', rb'"\u00e9"']
SCALARS = [*NUMBERS, *TEXTS, b"true", b"false", b"null"]
TOO_LARGE = [b"1e309", b"1E+400", b"1" * 310 + b".0", b"1" * 211 + b"e99", b"1" * 5000, b"[" * 70 + b"]" * 70]
NO_TEXTS = [b'"\xff"', b'"\xed\xa0\x80"', b'"\xc3"', b'{"\xff":1}', rb'"\ud800"', rb'"\q"', b'"']
REFUSED = [*TOO_LARGE, *NO_TEXTS, b"NaN", b"01", b"[1,]", b'{"a":1', b"]"]


def random_value(random: Random, scalars: Sequence[bytes], depth: int) -> bytes:
    """JSON, of maps with keys that may occur twice and that paths may name."""
    kind = random.random() if depth else 1.0
    inside = [random_value(random, scalars, depth - 1) for _ in range(random.randrange(5))] if kind < 0.7 else []
    if kind < 0.55:
        keys = [rb'"\u0061"', *(f'"{name}"'.encode() for name in NAMES)]
        return b" {" + b",".join(random.choice(keys) + b": " + value for value in inside) + b"}"
    return b"[" + b", ".join(inside) + b"]" if kind < 0.7 else random.choice(scalars)


def random_paths(random: Random) -> list[Path]:
    steps: list[str | int] = [*NAMES, *NAMES, 0, 1, 2]
    return [
        (random.choice(NAMES), *random.choices(steps, k=random.randrange(4))) for _ in range(random.randrange(1, 5))
    ]


def column(path: Path, *payloads: bytes) -> list[Any]:
    reader = JsonDecoder().field_reader([path])
    assert reader is not None
    return list(reader(payloads).columns[0])


def test_values_are_plain_as_decoded_or_missing() -> None:
    payloads = [b'{"a": 1}', b'{"a": 9007199254740993}', b'{"b": 1}', b'{"a": [1, {"x": 2}]}', b'{"a": null}', b"{"]
    assert column(("a",), *payloads) == [1.0, 2**53 + 1, MISSING, [1.0, {"x": 2.0}], None, MISSING]
    assert [type(value) for value in column(("a",), *payloads)[:2]] == [float, int]


def test_a_path_through_a_json_scalar_makes_the_message_odd() -> None:
    reader = JsonDecoder().field_reader([("a", "x"), ("b",)])
    assert reader is not None
    found = reader([b'{"a": {"x": 1}, "b": 2}', b'{"a": "x", "b": 2}', b'{"a": null}', b"[]", b"{}", b'{"a": {}}'])
    assert list(found.odd) == [1, 2, 3]
    assert list(found.columns[0]) == [1.0, *[MISSING] * 5]
    assert list(found.columns[1]) == [2.0, 2.0, *[MISSING] * 4]


def test_paths_that_lie_below_each_other_and_indices_are_read() -> None:
    reader = JsonDecoder().field_reader([("a", "x"), ("a",), ("a", "x"), ("l", 1, "y"), ("l", 7)])
    assert reader is not None
    found = reader([b'{"a": {"x": 1}, "l": [0, {"y": 2}]}'])
    assert [list(values) for values in found.columns] == [[1.0], [{"x": 1.0}], [1.0], [2.0], [MISSING]]


def test_without_paths_only_unreadable_payloads_are_reported() -> None:
    assert assert_reads_as_decoded(JsonDecoder(), [], [b"{}", b"1", b"{"]) == 1


@pytest.mark.parametrize("seed", range(20))
def test_random_messages_valid_and_broken_read_as_decoded(seed: int) -> None:
    random = Random(seed)
    scalars = SCALARS * 6 + REFUSED if seed % 2 else SCALARS
    for _ in range(30):
        payloads = [random_value(random, scalars, 4) for _ in range(random.choice((1, 10, 100)))]
        assert_reads_as_decoded(JsonDecoder(), random_paths(random), payloads)


def test_thousands_of_hostile_payloads_read_as_decoded() -> None:
    valid = [b'{"header": {"stamp": 1.5, "frame": "m\xc3\xa4p"}, "objects": [{"x": 1.0, "id": 7}, null, true]}']
    some: list[Path] = [("header", "stamp"), ("objects", 0, "x")]
    assert_reads_as_decoded(JsonDecoder(), some, [*hostile.payloads(valid * 64, 64, seed=0), *valid * 200])
    payloads = [*hostile.payloads([*valid, b'{"header": 1e308}'], 5_000, seed=1)]
    assert 1_000 < assert_reads_as_decoded(JsonDecoder(), some, payloads) < 4_990


@pytest.mark.parametrize("depth", [MAX_DEPTH - 1, MAX_DEPTH, MAX_DEPTH + 1])
@pytest.mark.parametrize(
    "skipped", [b'[%s"]"]', b'[%s"["]', rb'["\"",%s"\\"]', b'{"a":{},"b":[%s]}', b'["","[[",[%s],"]]"]']
)
def test_depth_counts_in_skipped_values_too(skipped: bytes, depth: int) -> None:
    fill = b"[" * (depth - 2) + b"]" * (depth - 2) + b","
    for inner in (fill, fill + b"[[], {}, []]," * 20, b'{"x":' * (depth - 2) + b"0" + b"}" * (depth - 2) + b","):
        payload = b'{"x": 1, "skipped": ' + skipped.replace(b"%s]", inner[:-1] + b"]").replace(b"%s", inner) + b"}"
        assert_reads_as_decoded(JsonDecoder(), [("x",)], [b'{"x": 2}', payload])


@pytest.mark.parametrize("depth", [MAX_DEPTH - 1, MAX_DEPTH])
@pytest.mark.parametrize(("first", "last"), [(b'"]"', b'"["'), (rb'"\"]\""', rb'"\"[\""'), (rb'"]\\"', rb'"[\\"')])
def test_brackets_in_texts_do_not_count_as_nesting(first: bytes, last: bytes, depth: int) -> None:
    nested_lists = (b"[" + first + b",") * depth + b"0" + (b"," + last + b"]") * depth
    refused = assert_reads_as_decoded(JsonDecoder(), [("x",)], [b'{"x": 1, "skipped": ' + nested_lists + b"}"])
    assert refused == (depth == MAX_DEPTH)


class FieldsOnly(JsonDecoder):
    """Fails where a reader of fields decodes a message whole."""

    def decode(self, payload: bytes) -> Any:
        raise AssertionError(payload)


def test_messages_that_fit_are_not_decoded_whole() -> None:
    reader = FieldsOnly().field_reader([("x",), ("a", "b", "c"), ("list", 1)])
    assert reader is not None
    maps = rb'{"name": "a \"b\" c\\", "list": [[], [1.5e3]]}, ' * 100
    found = reader(
        [b"{}", b'{"x": null, "a": {"b": {}}}', b'{"x": "car-e1234", "list": [' + maps + b'"\xc3\xa4"]}'] * 99
    )
    assert not found.errors
    assert found.columns[0][:3] == [MISSING, None, "car-e1234"]


@pytest.mark.parametrize("path", [(0,), (0, "x"), ('"',), ("a", "\\"), ("\0",), ("\ud800",)])
def test_paths_that_need_the_whole_message_have_no_field_reader(path: Path) -> None:
    assert JsonDecoder().field_reader([path, ("x",)]) is None


def test_other_decoders_read_whole_messages() -> None:
    assert isinstance(JsonDecoder(), FieldDecoder)
    assert not isinstance(CborDecoder(), FieldDecoder)
    assert not isinstance(RawDecoder(), FieldDecoder)
