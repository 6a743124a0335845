"""CBOR of any encoder reads like JSON; raw payloads are passed through."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from decimal import Decimal
from typing import Any
from uuid import UUID

import cbor2
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detector.engine.samples.sample import DecodeError
from detector.streams.codecs import CborDecoder, RawDecoder
from detector.streams.codecs.cbor import MAX_DEPTH
from tests.driving import Drive, a_detector, a_rule, arrival
from tests.unit.encodings import hostile
from wayside.expressions.numbers import MAX_EXACT

values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats(allow_nan=False) | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
)


@given(values, st.booleans(), st.booleans())
def test_output_of_cbor2_reads_back_with_doubles(value: Any, canonical: bool, indefinite: bool) -> None:
    written = cbor2.dumps(value, canonical=canonical, indefinite_containers=indefinite and not canonical)
    decoded = CborDecoder().decode(written)
    assert decoded == value
    hostile.assert_plain(decoded)


@pytest.mark.parametrize(
    ("value", "read"),
    [
        (3, 3.0),
        (MAX_EXACT + 1, MAX_EXACT + 1),
        (-(2**64), -(2**64)),
        (2**80, 2**80),
        (Decimal("1.25"), 1.25),
        (Decimal("1e400"), math.inf),
        (datetime(2026, 1, 1, tzinfo=UTC), "2026-01-01T00:00:00Z"),
        (cbor2.CBORTag(1, 1.5), 1.5),
        (cbor2.CBORTag(5, [-1, 3]), 1.5),
        (cbor2.CBORTag(4711, [cbor2.CBORTag(4712, 2)]), [2.0]),
        (cbor2.CBORTag(55799, {"a": 1}), {"a": 1.0}),
        (UUID(int=1), bytes(15) + b"\x01"),
        (cbor2.undefined, None),
        (cbor2.CBORSimpleValue(99), None),
        ({1: "one", -(2**70): 2}, {"1": "one", str(-(2**70)): 2.0}),
    ],
    ids=str,
)
def test_cbor_values_without_a_json_equivalent_are_read_as_plain_values(value: Any, read: Any) -> None:
    decoded = CborDecoder().decode(cbor2.dumps(value))
    assert decoded == read
    assert type(decoded) is type(read)


CYCLE = b"\xd8\x1c\x81\xd8\x1d\x00"  # tag 28: a list of one item, tag 29: that very list


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        (b"", "premature end"),
        (cbor2.dumps([1, 2])[:-1], "premature end"),
        (b"\x01\x02", "there are bytes after"),
        (b"\xff", "break"),
        (b"\x62\xff\xff", "utf-8"),
        (b"\x9b" + b"\xff" * 8, "premature end"),
        (b"\x5b\x7f" + b"\xff" * 7, "premature end"),
        (b"\xc2\x01", "byte string"),
        (b"\xc4\x01", "exponent and mantissa"),
        (cbor2.dumps(cbor2.CBORTag(5, [2**64, 1])), "exponent and mantissa"),
        (CYCLE, "shared values"),
        (cbor2.dumps({(1, 2): 3}), "tuple as a key"),
        (cbor2.dumps({True: 3}), "bool as a key"),
        (b"\x81" * (MAX_DEPTH + 1) + b"\x01", "depth"),
        (b"\xc1" * 1_000_000 + b"\x01", "depth"),
    ],
    ids=lambda value: repr(value[:20]) if isinstance(value, bytes) else value,
)
def test_invalid_cbor_is_rejected(payload: bytes, words: str) -> None:
    with pytest.raises(DecodeError, match=words):
        CborDecoder().decode(payload)


def test_a_fraction_beyond_all_doubles_costs_nothing() -> None:
    assert CborDecoder().decode(b"\xc5\x82\x1b\x7f" + b"\xff" * 7 + b"\x01") == math.inf
    assert CborDecoder().decode(b"\xc4\x82\x3b\x7f" + b"\xff" * 7 + b"\x01") == 0.0


MESSAGES = [
    cbor2.dumps({"header": {"stamp": 1.5, "frame": "map"}, "objects": [{"x": 1.0, "id": n} for n in range(5)]}),
    cbor2.dumps([Decimal("1.5"), 2**80, datetime(2026, 1, 1, tzinfo=UTC), b"bytes", {1: None}, UUID(int=7)]),
    cbor2.dumps({"a": ["same text"] * 3}, string_referencing=True),
    cbor2.dumps({"a": [1, {"b": True}]}, indefinite_containers=True),
    CYCLE,
]


def test_ten_thousand_hostile_payloads_give_a_value_or_a_decode_error() -> None:
    refused = hostile.survive(CborDecoder(), hostile.payloads(MESSAGES, 10_000, seed=1))
    assert 3000 < refused < 9900


def test_raw_is_handed_through() -> None:
    assert RawDecoder().decode(b"\x00\xff") == b"\x00\xff"
    assert RawDecoder().stamp(b"\x00\xff") is None


def test_rules_see_cbor_values_and_the_size_of_raw_samples() -> None:
    detector = a_detector(
        {"name": "speed", "key": "vehicles/${client:*}/speed", "encoding": "cbor"},
        {"name": "camera", "key": "vehicles/${client:*}/camera", "encoding": "raw"},
    )
    fast = a_rule("fast", signals=[{"name": "v", "stream": "speed", "value": "msg.v"}], when="v > 10")
    large = a_rule("large", signals=[{"name": "size", "stream": "camera", "value": "sample.size"}], when="size > 3")
    drive = Drive(detector, fast, large)
    speed, camera = cbor2.dumps({"v": 11}), b"\x00\xff\x00\xff"
    assert drive.take(arrival(0.5, "car", speed), arrival(0.6, "car", camera, "camera"), until=1) == [
        "fast car started 1",
        "large car started 1",
    ]
    drive.take(arrival(1.5, "car", b"\xff"), until=2)
    assert drive.engine.counters.undecodable == {"speed": 1}
    assert "not CBOR" in drive.engine.counters.last_undecodable["speed"]
