"""The headers of ITS messages: GeoNetworking, BTP and security, built byte by byte or by pycrate."""

from __future__ import annotations

import importlib
import struct
from typing import Any

import pytest

from detector.engine.samples.sample import DecodeError
from detector.streams.codecs.etsi import EtsiDecoder
from detector.streams.codecs.etsi.packets import message_in
from tests.unit.encodings.its_messages import a_cam

CAM = a_cam(station=321)
LONG_POSITION = bytes(range(24))
AREA = struct.pack(">iiHHHH", 507773210, 61234567, 100, 100, 0, 0)

EXTENDED = {
    "a single hop (SHB)": (5, 0, LONG_POSITION + bytes(4)),
    "several hops (TSB)": (5, 1, struct.pack(">HH", 7, 0) + LONG_POSITION),
    "a place (GBC)": (4, 0, struct.pack(">HH", 7, 0) + LONG_POSITION + AREA),
    "anyone at a place (GAC)": (3, 1, struct.pack(">HH", 7, 0) + LONG_POSITION + AREA),
    "one station (GUC)": (2, 0, struct.pack(">HH", 7, 0) + LONG_POSITION + bytes(20)),
}
"""Header type, subtype and extended header, by the destination of a packet."""


def btp(message: bytes, port: int = 2001) -> bytes:
    return struct.pack(">HH", port, 0) + message


def common(
    body: bytes, kind: int, subtype: int, extended: bytes, following: int = 2, length: int | None = None
) -> bytes:
    length = len(body) if length is None else length
    return struct.pack(">BBBBHBB", following << 4, kind << 4 | subtype, 2, 0, length, 1, 0) + extended + body


def packet(inner: bytes, following: int = 1, version: int = 1) -> bytes:
    return struct.pack(">BBBB", version << 4 | following, 0, 0x1A, 1) + inner


def single_hop(message: bytes = CAM) -> bytes:
    return common(btp(message), *EXTENDED["a single hop (SHB)"])


def secured(content: tuple[str, Any]) -> bytes:
    """IEEE 1609.2 data, encoded by pycrate."""
    kind = importlib.import_module("pycrate_asn1dir.ITS_IEEE1609_2").Ieee1609Dot2.Ieee1609Dot2Data
    kind.set_val({"protocolVersion": 3, "content": content})
    return bytes(kind.to_coer())


def signed(payload: bytes) -> bytes:
    inner = {"protocolVersion": 3, "content": ("unsecuredData", payload)}
    return secured(
        (
            "signedData",
            {
                "hashId": "sha256",
                "tbsData": {"payload": {"data": inner}, "headerInfo": {"psid": 36, "generationTime": 1}},
                "signer": ("digest", b"12345678"),
                "signature": ("ecdsaNistP256Signature", {"rSig": ("x-only", bytes(32)), "sSig": bytes(32)}),
            },
        )
    )


@pytest.mark.parametrize("addressed", EXTENDED)
@pytest.mark.parametrize("following", [1, 2])
@pytest.mark.parametrize("version", [0, 1])
def test_a_message_is_found_in_every_kind_of_geonetworking_packet(addressed: str, following: int, version: int) -> None:
    kind, subtype, extended = EXTENDED[addressed]
    raw = packet(common(btp(CAM), kind, subtype, extended, following), version=version)
    assert message_in(raw) == CAM
    assert message_in(raw + bytes(9)) == CAM, "the padding of short Ethernet frames is not the message's"


@pytest.mark.parametrize("port", [2001, 2002, 2009, 2018])
def test_a_message_is_found_behind_btp_alone_and_on_its_own(port: int) -> None:
    assert message_in(btp(CAM, port)) == CAM
    assert message_in(CAM) == CAM


@pytest.mark.parametrize("message", [CAM, CAM + bytes(300)])
def test_a_message_is_found_in_signed_and_unsigned_envelopes(message: bytes) -> None:
    assert message_in(packet(signed(single_hop(message)), following=2)) == message
    assert message_in(packet(secured(("unsecuredData", single_hop(message))), following=2)) == message
    assert message_in(signed(message)) == message
    assert message_in(signed(packet(single_hop(message)))) == message


def test_the_decoder_takes_packets_and_bare_messages_alike() -> None:
    decoder = EtsiDecoder("etsi/cam")
    for raw in (CAM, btp(CAM), packet(single_hop()), packet(signed(single_hop()), following=2)):
        assert decoder.decode(raw) == decoder.decode(CAM)


ENCRYPTED = {
    "recipients": [("pskRecipInfo", b"12345678")],
    "ciphertext": ("aes128ccm", {"nonce": b"n" * 12, "ccmCiphertext": b"secret" * 20}),
}


@pytest.mark.parametrize(
    ("raw", "problem"),
    [
        (packet(secured(("encryptedData", ENCRYPTED)), following=2), "encrypted for its receiver"),
        (packet(b"\x02" + signed(CAM)[1:], following=2), "secured packet has version 2; only 3"),
        (packet(secured(("signedCertificateRequest", b"abcd")), following=2), "has no data"),
        (packet(signed(single_hop())[:9], following=2), "announces|ends"),
        (packet(common(b"", 1, 0, LONG_POSITION, following=0)), "a beacon of GeoNetworking contains no message"),
        (packet(common(b"", 6, 0, bytes(36), following=0)), "a location service packet"),
        (packet(common(b"", 9, 0, b"")), "header type 9"),
        (packet(common(btp(CAM), *EXTENDED["a single hop (SHB)"], following=3)), "next header 3: only BTP"),
        (
            packet(common(btp(CAM), *EXTENDED["a single hop (SHB)"], length=900)),
            "announces 900 bytes of payload, but has 4",
        ),
        (packet(common(btp(CAM), *EXTENDED["a single hop (SHB)"], length=2)), "announces 2 bytes of payload"),
        (packet(b"\x20\x50"), "ends within its headers"),
        (b"\x02\x02", "an ITS message must have more than 6 bytes; got 2"),
        (bytes(70_000), "an ITS packet must have at most 65535 bytes; got 70000"),
    ],
)
def test_packets_without_a_readable_message_report_the_reason(raw: bytes, problem: str) -> None:
    with pytest.raises(DecodeError, match=problem):
        message_in(raw)


def test_nesting_of_envelopes_is_bounded() -> None:
    raw = CAM
    for _ in range(3000):
        raw = b"\x03\x80\x82" + len(raw).to_bytes(2, "big") + raw
    with pytest.raises(DecodeError, match="envelopes"):
        message_in(raw)
