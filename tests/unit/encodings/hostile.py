"""Payloads of a broken or hostile sender: noise and tampered messages."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from random import Random
from typing import Any

from detector.engine.samples.sample import DecodeError, Decoder
from wayside.expressions.numbers import MAX_EXACT

_LARGE = (b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\x7f\xff\xff\xff\xff\xff\xff\xff")
"""Bytes that make a length or a count huge or negative."""


def payloads(valid: Sequence[bytes], count: int, seed: int) -> Iterator[bytes]:
    """That many, always the same for a seed; most begin as one of the valid messages."""
    random = Random(seed)
    for _ in range(count):
        raw = bytearray(random.choice(valid))
        for _ in range(random.randint(1, 4)):
            raw = _tampered(raw, random)
        yield bytes(raw)


def _tampered(raw: bytearray, random: Random) -> bytearray:
    place = random.randint(0, len(raw))
    match random.randrange(8):
        case 0:
            return bytearray(random.randbytes(random.randint(0, 64)))
        case 1:
            return raw[:place]
        case 2:
            return raw + random.randbytes(random.randint(1, 16))
        case 3:
            return raw[:place] + random.randbytes(random.randint(1, 8)) + raw[place:]
        case 4:
            return raw[:place] + raw[place + random.randint(1, 8) :]
        case 5:
            large = random.choice(_LARGE)
            return raw[:place] + large + raw[place + len(large) :]
        case _:
            if place < len(raw):
                raw[place] ^= 1 << random.randrange(8)
            return raw


def survive(codec: Decoder, hostile: Iterator[bytes]) -> int:
    """Read them all; returns how many were refused. Fails on anything but a plain value or DecodeError."""
    refused = 0
    for payload in hostile:
        try:
            assert_plain(codec.decode(payload))
        except DecodeError:
            refused += 1
        with suppress(DecodeError):
            stamp = codec.stamp(payload)
            assert stamp is None or stamp >= 0
    return refused


def assert_plain(value: Any) -> None:
    """Check that the value is plain data."""
    if isinstance(value, dict):
        for key, item in value.items():
            assert type(key) is str
            assert_plain(item)
    elif isinstance(value, list):
        for item in value:
            assert_plain(item)
    elif type(value) is int:
        assert abs(value) > MAX_EXACT
    else:
        assert type(value) in (float, str, bool, bytes, type(None))
