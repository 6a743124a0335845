"""Captures of ITS packets as recordings: pcap and pcapng, with the frames that stations' radios and Ethernets have."""

from __future__ import annotations

import random
import struct
from pathlib import Path

import pytest

from detector.replay.message import Message, RecordingError, Truncation
from detector.streams.codecs.etsi.quantities import its_ms
from tests.driving import a_detector, a_rule, a_stream
from tests.recorded import messages_in
from tests.unit.encodings.its_messages import a_cam, random_message
from tests.unit.encodings.test_etsi_packets import EXTENDED, LONG_POSITION, btp, common, packet, signed, single_hop
from tests.unit.recordings.command_line import CommandLine

SECOND = 10**9
START = 1_767_225_600 * SECOND

GEONETWORKING = b"\x89\x47"
CAM = packet(single_hop())


def ethernet(payload: bytes, protocol: bytes = GEONETWORKING) -> bytes:
    return bytes(12) + protocol + payload


FRAMES = {
    "Ethernet": (1, ethernet(CAM)),
    "Ethernet, padded": (1, ethernet(CAM) + bytes(20)),
    "Ethernet with VLAN": (1, bytes(12) + b"\x81\x00\x00\x05" + GEONETWORKING + CAM),
    "Linux cooked": (113, bytes(14) + GEONETWORKING + CAM),
    "Linux cooked, version 2": (276, GEONETWORKING + bytes(18) + CAM),
    "802.11": (105, b"\x08\x00" + bytes(22) + b"\xaa\xaa\x03\x00\x00\x00" + GEONETWORKING + CAM),
    "802.11 QoS with radiotap": (
        127,
        b"\x00\x00\x09\x00" + bytes(5) + b"\x88\x00" + bytes(24) + b"\xaa\xaa\x03\x00\x00\x00" + GEONETWORKING + CAM,
    ),
}


def pcap(frames: list[tuple[int, bytes]], link: int = 1, order: str = "<", nanoseconds: bool = False) -> bytes:
    magic = 0xA1B23C4D if nanoseconds else 0xA1B2C3D4
    raw = struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 65535, link)
    for time, frame in frames:
        fraction = time % SECOND if nanoseconds else time % SECOND // 1000
        raw += struct.pack(order + "IIII", time // SECOND, fraction, len(frame), len(frame)) + frame
    return raw


def block(kind: int, body: bytes, order: str) -> bytes:
    body += bytes(-len(body) % 4)
    length = struct.pack(order + "I", len(body) + 12)
    return struct.pack(order + "I", kind) + length + body + length


def pcapng(frames: list[tuple[int, bytes]], link: int = 1, order: str = "<") -> bytes:
    """With times in nanoseconds, by an option of the interface."""
    raw = block(0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1), order)
    raw += block(1, struct.pack(order + "HHIHHB3xHH", link, 0, 65535, 9, 1, 9, 0, 0), order)
    raw += block(5, bytes(12), order)  # statistics, which are passed over
    for time, frame in frames:
        head = struct.pack(order + "IIIII", 0, time >> 32, time & 0xFFFFFFFF, len(frame), len(frame))
        raw += block(6, head + frame, order)
    return raw


def read(path: Path, raw: bytes) -> list[Message]:
    path.write_bytes(raw)
    return list(messages_in([path]))


@pytest.mark.parametrize("name", FRAMES)
def test_geonetworking_is_found_in_frames_of_every_link(name: str, tmp_path: Path) -> None:
    link, frame = FRAMES[name]
    (message,) = read(tmp_path / "capture.pcap", pcap([(START, frame)], link))
    assert message == Message(START, "etsi/cam", message.payload, "uper", None)
    assert message.payload.startswith(CAM)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("write", [pcap, pcapng, lambda frames, order: pcap(frames, 1, order, nanoseconds=True)])
def test_both_formats_are_read_in_both_byte_orders(write: object, order: str, tmp_path: Path) -> None:
    frames = [
        (START + 2_000_000, ethernet(CAM)),
        (START + 1_000_000, ethernet(CAM)),
        (START + 5 * SECOND, ethernet(CAM)),
    ]
    messages = read(tmp_path / "capture", write(frames, order=order))  # type: ignore[operator]
    assert [message.time - START for message in messages] == [1_000_000, 2_000_000, 5 * SECOND]


def test_packets_get_the_keys_of_their_messages_and_other_frames_are_skipped(tmp_path: Path) -> None:
    denm, _ = random_message("denm", random.Random(1))
    area = EXTENDED["a place (GBC)"]
    frames = [
        ethernet(packet(common(btp(denm, 2002), *area))),
        ethernet(packet(signed(single_hop()), following=2)),
        ethernet(packet(common(b"", 1, 0, LONG_POSITION, following=0))),
        ethernet(b"\x45" + bytes(40), protocol=b"\x08\x00"),
        b"",
    ]
    raw = pcapng([(START + index, frame) for index, frame in enumerate(frames)])
    assert [message.key for message in read(tmp_path / "c", raw)] == ["etsi/denm", "etsi/cam", "etsi/other"]


@pytest.mark.parametrize("write", [pcap, pcapng])
def test_a_truncated_capture_is_read_up_to_the_cut(write: object, tmp_path: Path) -> None:
    raw = write([(START + index, ethernet(CAM)) for index in range(3)])  # type: ignore[operator]
    path = tmp_path / "capture"
    whole = read(path, raw)
    counts = set()
    for size in range(30, len(raw)):
        path.write_bytes(raw[:size])
        reported: list[Truncation] = []
        messages = list(messages_in([path], on_cut=reported.append))
        assert messages == whole[: len(messages)]
        assert all(cut.messages == len(messages) for cut in reported)
        counts.add((len(messages), len(reported)))
    # Between two packets nothing shows that there were more.
    assert {(0, 1), (1, 1), (2, 1)} <= counts <= {(0, 0), (0, 1), (1, 0), (1, 1), (2, 0), (2, 1)}


def test_a_capture_that_is_damaged_is_reported(tmp_path: Path) -> None:
    raw = bytearray(pcapng([(START, ethernet(CAM))]))
    raw[4:8] = struct.pack("<I", 27)  # no length of a block
    with pytest.raises(RecordingError, match="the capture is damaged: the block at byte 0 has the invalid length 27"):
        read(tmp_path / "capture", bytes(raw))


CAM_STREAM = a_stream("cam", key="etsi/cam", encoding="uper", type="etsi/cam", client="its-${msg.header.stationId}")
SPEED = "msg.cam.camParameters.highFrequencyContainer.basicVehicleContainerHighFrequency.speed.speedValue"
FAST = a_rule(
    "fast",
    signals=[{"name": "speed", "stream": "cam", "value": SPEED}],
    when="speed > 10",
    evaluation={"every": "1s"},
)


@pytest.mark.parametrize(("clock", "start"), [("Wall", 1), ("Data", 0)])  # captured 3 ms after they were made
def test_a_capture_is_replayed(clock: str, start: int, command: CommandLine) -> None:
    frames = []
    for index in range(12):
        time = START + index * SECOND // 2
        frames.append((time + 3_000_000, ethernet(packet(single_hop(a_cam(station=7, milliseconds=its_ms(time)))))))
    (command.folder / "capture.pcapng").write_bytes(pcapng(frames))
    command.write(a_detector(CAM_STREAM, clock=clock), FAST)
    ran = command.replay("capture.pcapng")
    assert ran.code == 0, ran.logged
    (event,) = ran.events
    assert event["subject"] == "its-7"
    assert event["data"]["startTime"] == f"2026-01-01T00:00:0{start}.000000000Z"
