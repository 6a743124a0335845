"""The layers around an ITS message on the air: GeoNetworking, the security envelope, BTP. They are removed, not
verified.

The bytes show which layers are present. A message begins with its protocol version and a message number that is not
zero, GeoNetworking's basic header has a zero at that position, and BTP begins with a port from 2001 on. Signatures are
not verified: a rule that must rely on the sender of a message needs a receiver that verifies before it forwards.

Headers as in ETSI EN 302 636-4-1 (GeoNetworking), EN 302 636-5-1 (BTP) and IEEE 1609.2 / TS 103 097 (security).
"""

from __future__ import annotations

from detector.engine.samples.sample import DecodeError

MAXIMUM = 65535
"""Bytes; no packet of an ITS station is longer."""

ETHERTYPE = 0x8947
"""GeoNetworking in an Ethernet frame."""

_PORTS = range(2001, 2025)
"""BTP's well-known destination ports (TS 103 248): 2001 CAM, 2002 DENM, 2003 MAPEM, 2004 SPATEM, 2009 CPM, 2018 VAM."""

_SECURED = 2
"""The header after the basic header; 0 and 1 are the common header."""

_BTP_A, _BTP_B = 1, 2
"""The header after the GeoNetworking headers; BTP's two kinds have the destination port at the same position."""

_BASIC, _COMMON_LENGTH, _BTP_LENGTH = 4, 8, 4

_EXTENDED = {2: 48, 3: 44, 4: 44, 5: 28}
"""Bytes of the extended header, by header type: GeoUnicast, GeoAnycast, GeoBroadcast, single hop and multi-hop TSB."""

_WITHOUT_MESSAGE = {1: "a beacon", 6: "a location service packet"}

_LONG = 0x80

_SECURITY = 3
"""The protocol version of IEEE 1609.2 data."""

_UNSECURED, _SIGNED, _ENCRYPTED = 0x80, 0x81, 0x82
"""The tags of its alternatives."""


_DATA_PRESENT = 0x40
"""The bit in the preamble of a SignedDataPayload for the presence of the data."""

_NESTED = 4
"""Maximum nesting of secured packets."""


def message_in(payload: bytes) -> bytes:
    """The message without its outer layers. Raises DecodeError if there is none, or if it cannot be read."""
    if len(payload) > MAXIMUM:
        raise DecodeError(f"an ITS packet must have at most {MAXIMUM} bytes; got {len(payload)}")
    for _ in range(_NESTED):
        if len(payload) < 6:
            raise DecodeError(f"an ITS message must have more than 6 bytes; got {len(payload)}")
        if _is_geonetworking(payload):
            return _from_geonetworking(payload)
        if _is_btp(payload):
            return payload[_BTP_LENGTH:]
        if not _is_secured(payload):
            return payload
        payload = _from_secured(payload)
    raise DecodeError(f"the message must be in fewer than {_NESTED} nested envelopes")


def _is_geonetworking(packet: bytes) -> bool:
    return packet[0] >> 4 in (0, 1) and packet[0] & 15 <= _SECURED and packet[1] == 0


def _is_btp(packet: bytes) -> bool:
    return int.from_bytes(packet[:2], "big") in _PORTS


def _is_secured(packet: bytes) -> bool:
    return packet[0] == _SECURITY and packet[1] >= _UNSECURED


def _from_geonetworking(packet: bytes) -> bytes:
    inner = packet[_BASIC:]
    if packet[0] & 15 == _SECURED:
        inner = _from_secured(inner)
    if len(inner) < _COMMON_LENGTH:
        raise DecodeError(f"the GeoNetworking packet ends within its headers ({len(packet)} bytes)")
    kind = inner[1] >> 4
    if kind in _WITHOUT_MESSAGE:
        raise DecodeError(f"{_WITHOUT_MESSAGE[kind]} of GeoNetworking contains no message")
    extended = _EXTENDED.get(kind)
    if extended is None:
        raise DecodeError(f"the GeoNetworking packet has the unknown header type {kind}")
    transport = inner[0] >> 4
    if transport not in (_BTP_A, _BTP_B):
        raise DecodeError(f"the GeoNetworking packet has next header {transport}: only BTP carries ITS messages")
    start = _COMMON_LENGTH + extended
    length = int.from_bytes(inner[4:6], "big")
    body = inner[start : start + length]
    if len(body) < length or length < _BTP_LENGTH:
        raise DecodeError(f"the GeoNetworking packet announces {length} bytes of payload, but has {len(body)}")
    return body[_BTP_LENGTH:]


def _from_secured(data: bytes) -> bytes:
    """The payload of IEEE 1609.2 data (canonical OER), at any depth."""
    for _ in range(_NESTED):
        if len(data) < 4:
            raise DecodeError("the secured packet ends within its headers")
        if data[0] != _SECURITY:
            raise DecodeError(
                f"the secured packet has version {data[0]}; only {_SECURITY} (TS 103 097 v1.3 and later) is supported"
            )
        tag = data[1]
        if tag == _UNSECURED:
            return _octets(data, 2)
        if tag == _ENCRYPTED:
            raise DecodeError("the packet is encrypted for its receiver")
        if tag != _SIGNED:
            raise DecodeError(f"the secured packet has no data (alternative {tag & 63})")
        preamble = data[3]  # after the hash algorithm
        if not preamble & _DATA_PRESENT:
            raise DecodeError("the signed packet has only the hash of its data")
        data = data[4:]
    raise DecodeError(f"the secured packet must be in fewer than {_NESTED} nested envelopes")


def _octets(data: bytes, start: int) -> bytes:
    """An OCTET STRING in OER: its length, in one byte or preceded by the number of its bytes, then the contents."""
    length, start = data[start], start + 1
    if length & _LONG:
        size = length & ~_LONG
        length, start = int.from_bytes(data[start : start + size], "big"), start + size
    found = data[start : start + length]
    if len(found) < length:
        raise DecodeError(f"the secured packet announces {length} bytes of payload, but has {len(found)}")
    return found
