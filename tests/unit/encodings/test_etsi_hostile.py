"""Hostile bytes: thousands for each kind of message, noise and valid ones tampered with. Only DecodeError comes out."""

from __future__ import annotations

import random
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from detector.engine.samples.sample import Arrival, DecodeError
from detector.streams.codecs.etsi import EtsiDecoder
from detector.streams.codecs.etsi.packets import message_in
from tests.driving import Drive, a_detector, a_rule, at
from tests.unit.encodings.hostile import assert_plain, payloads
from tests.unit.encodings.its_messages import PDUS, a_cam, random_message
from tests.unit.encodings.test_etsi_packets import packet, signed, single_hop

COUNT = 1700
"""For each of six kinds: ten thousand in all."""

SEED = 103_097


@pytest.mark.parametrize("name", PDUS)
def test_ten_thousand_hostile_messages_raise_only_decode_errors(name: str) -> None:
    chance = random.Random(name)
    decoder = EtsiDecoder("etsi/" + name.split(maxsplit=1)[0])
    valid = [random_message(name, chance)[0] for _ in range(20)]
    valid += [packet(single_hop(raw)) for raw in valid[:5]] + [packet(signed(single_hop(raw)), 2) for raw in valid[:5]]
    outcomes = {"read": 0, "refused": 0}
    noise = (chance.choice(valid)[:6] + chance.randbytes(chance.randrange(200)) for _ in range(COUNT // 4))
    for raw in (*noise, *payloads(valid, COUNT - COUNT // 4, seed=SEED)):
        try:
            assert_plain(decoder.decode(raw))
            stamp = decoder.stamp_near(raw, at(0))
            assert stamp is None or stamp >= 0
            outcomes["read"] += 1
        except DecodeError:
            outcomes["refused"] += 1
    assert min(outcomes.values()) > COUNT // 20, outcomes


@given(st.binary(max_size=60), st.sampled_from([b"\x11\x00\x1a\x01", b"\x12\x00\x1a\x01\x03\x81\x00\x40", b"\x03\x81"]))
def test_noise_after_valid_headers_raises_only_decode_errors(raw: bytes, headers: bytes) -> None:
    with suppress(DecodeError):
        message_in(headers + raw)


def test_unreadable_its_messages_are_counted_and_others_continue() -> None:
    stream = {"name": "cam", "key": "its/${client:*}/cam", "encoding": "uper", "type": "etsi/cam"}
    rule = a_rule(
        signals=[{"name": "at", "stream": "cam", "value": "msg.cam.generationDeltaTime"}],
        when="at > 10",
        evaluation={"every": "1s"},
    )
    drive = Drive(a_detector(stream), rule)
    events = drive.take(
        Arrival(at(0.1), "cam", "its/a/cam", a_cam()[:-9]),
        Arrival(at(0.2), "cam", "its/b/cam", a_cam()),
        Arrival(at(0.3), "cam", "its/c/cam", b"\x02\x01 a DENM"),
        until=1,
    )
    assert events == ["r b started 1"]
    assert drive.engine.counters.undecodable["cam"] == 2
    assert drive.engine.counters.last_undecodable["cam"].startswith("its/c/cam: message 1 (etsi/denm), but the stream")
