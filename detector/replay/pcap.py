"""Captured packets of ITS stations: pcap and pcapng files with GeoNetworking frames.

A frame becomes a message on the key `etsi/cam`, `etsi/denm` and so on, by its contents, or on `etsi/other` if these are
unknown (beacons, encrypted packets). Frames of other protocols are skipped. The file formats and link types follow the
pcap and pcapng drafts of the IETF (opsawg) and tcpdump's list of link types.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

from detector.engine.samples.sample import DecodeError
from detector.replay.batches import Batch, batched
from detector.replay.message import Message, OnCut, RecordingError, Truncation, Wanted
from detector.streams.codecs.etsi.messages import BY_NUMBER, PREFIX
from detector.streams.codecs.etsi.packets import ETHERTYPE, message_in

MAGICS = (b"\xa1\xb2\xc3\xd4", b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\x3c\x4d", b"\x4d\x3c\xb2\xa1", b"\x0a\x0d\x0d\x0a")
"""The beginnings of such files: pcap with micro- or nanoseconds in either byte order, and pcapng."""

OTHER = PREFIX + "other"
"""The key of packets whose message is unknown."""

_PCAPNG = MAGICS[-1]
_SECTION, _INTERFACE, _SIMPLE, _PACKET = 0x0A0D0D0A, 1, 3, 6
_RESOLUTION, _OFFSET = 9, 14
_LARGEST = 1 << 24
"""Bytes: no block of a valid file is larger."""

_VLAN = (0x8100, 0x88A8)
_SNAP = b"\xaa\xaa\x03\x00\x00\x00"
_SECOND = 10**9


class _Frame(NamedTuple):
    time: int
    link: int
    data: bytes


class _CutError(ValueError):
    """The file ends inside a packet or block."""


def read_pcap(path: Path, wanted: Wanted, on_cut: OnCut) -> Iterator[Batch]:
    """The file's ITS packets in the order of their times. Raises RecordingError if it is damaged."""
    messages = []
    try:
        for time, link, data in _frames(path):
            packet = _geonetworking(link, data)
            if packet is not None:
                key = _key(packet)
                if wanted(key):
                    messages.append(Message(time, key, packet, "uper", None))
    except _CutError as error:
        on_cut(Truncation(path, len(messages), str(error)))
    # Captures of several interfaces go back in time by a little; they are small enough to be sorted as a whole.
    yield from batched(sorted(messages, key=attrgetter("time")))


def _key(packet: bytes) -> str:
    try:
        kind = BY_NUMBER.get(message_in(packet)[1])
    except DecodeError:
        return OTHER
    return OTHER if kind is None else PREFIX + kind.name


def _geonetworking(link: int, data: bytes) -> bytes | None:
    """The GeoNetworking packet in the frame; None if there is none."""
    match link:
        case 1:  # Ethernet
            start = 12
            while int.from_bytes(data[start : start + 2], "big") in _VLAN:
                start += 4
        case 113:  # Linux cooked capture
            start = 14
        case 276:  # Linux cooked capture, second version
            return data[20:] if data[:2] == ETHERTYPE.to_bytes(2, "big") else None
        case 105 | 127:  # IEEE 802.11, also with a radiotap header, as in ITS-G5 captures
            frame = data if link == 105 else data[int.from_bytes(data[2:4], "little") :]
            start = _behind_wifi(frame)
            data = frame
        case _:
            return None
    if int.from_bytes(data[start : start + 2], "big") != ETHERTYPE:
        return None
    return data[start + 2 :]


def _behind_wifi(frame: bytes) -> int:
    """The offset of the protocol in an IEEE 802.11 data frame with an LLC/SNAP header; its end for other frames."""
    if len(frame) < 24 or frame[0] & 0x0C != 0x08:
        return len(frame)
    start = 24 + (6 if frame[1] & 3 == 3 else 0) + (2 if frame[0] & 0x80 else 0)
    return start + len(_SNAP) if frame[start : start + len(_SNAP)] == _SNAP else len(frame)


def _frames(path: Path) -> Iterator[_Frame]:
    data = path.read_bytes()
    try:
        yield from _pcapng(data) if data.startswith(_PCAPNG) else _pcap(data)
    except _CutError:
        raise
    except struct.error as error:  # a read beyond the end
        raise _CutError("the file ends inside a header") from error
    except ValueError as error:
        raise RecordingError(
            f"{path}: the capture is damaged: {error}; `editcap` or Wireshark can save the intact part"
        ) from error


def _pcap(data: bytes) -> Iterator[_Frame]:
    order = "<" if data[0] in (0xD4, 0x4D) else ">"
    step = 1 if 0x4D in (data[0], data[3]) else 1000
    *_, link = struct.unpack_from(order + "HHiIII", data, 4)
    link &= 0xFFFF
    record = struct.Struct(order + "IIII")
    position = 24
    while position < len(data):
        seconds, fraction, length, _ = record.unpack_from(data, position)
        position += record.size
        if position + length > len(data):
            raise _CutError(f"the packet at byte {position} has {length} bytes and ends after the end of the file")
        yield _Frame(seconds * _SECOND + fraction * step, link, data[position : position + length])
        position += length


def _pcapng(data: bytes) -> Iterator[_Frame]:
    order, position = "<", 0
    interfaces: list[tuple[int, int, int]] = []
    while position < len(data):
        (kind,) = struct.unpack_from(order + "I", data, position)
        if kind == _SECTION:
            order = "<" if data[position + 8 : position + 12] == b"\x4d\x3c\x2b\x1a" else ">"
            interfaces = []
        (length,) = struct.unpack_from(order + "I", data, position + 4)
        if length < 12 or length % 4 or length > _LARGEST:
            raise ValueError(f"the block at byte {position} has the invalid length {length}")
        if position + length > len(data):
            raise _CutError(f"the block at byte {position} has {length} bytes and ends after the end of the file")
        body = data[position + 8 : position + length - 4]
        if kind == _INTERFACE:
            interfaces.append(_interface(body, order))
        elif kind == _PACKET:
            index, high, low, captured, _ = struct.unpack_from(order + "IIIII", body, 0)
            if index >= len(interfaces) or 20 + captured > len(body):
                raise ValueError(f"the packet at byte {position} has no interface {index}, or is longer than its block")
            link, units, offset = interfaces[index]
            time = (high << 32 | low) * _SECOND // units + offset * _SECOND
            yield _Frame(time, link, body[20 : 20 + captured])
        elif kind == _SIMPLE:
            raise ValueError("it has packets without timestamps (simple packet blocks)")
        position += length


def _interface(body: bytes, order: str) -> tuple[int, int, int]:
    """Link type, time units per second, and the seconds to add to times."""
    (link,) = struct.unpack_from(order + "H", body, 0)
    units, offset, position = 10**6, 0, 8
    while position + 4 <= len(body):
        option, length = struct.unpack_from(order + "HH", body, position)
        value = body[position + 4 : position + 4 + length]
        if option == 0:
            break
        if option == _RESOLUTION and value:
            units = 1 << (value[0] & 0x7F) if value[0] & 0x80 else 10 ** value[0]
        elif option == _OFFSET and length == 8:
            (offset,) = struct.unpack(order + "q", value)
        position += 4 + (length + 3) // 4 * 4
    return link, units, offset
