"""The traffic of a soak run: the cooperative-recording drive, telemetry, and occasional invalid messages."""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cbor2
import numpy as np
from pycrate_asn1dir.ITS_DENM_3 import DENM_PDU_Descriptions
from rosbags.typesys import Stores, get_typestore

DENM = DENM_PDU_Descriptions.DENM

_TYPES = get_typestore(Stores.ROS2_HUMBLE)
_IMAGE, _HEADER, _TIME = (
    _TYPES.types[name] for name in ("sensor_msgs/msg/Image", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
)

EXAMPLE = Path(__file__).parents[2] / "examples" / "cooperative-recording"
sys.path.insert(0, str(EXAMPLE))  # its folder's name has a dash, so it is no package

from cooperative_recording.messages import messages  # noqa: E402
from cooperative_recording.vehicles import VEHICLES, simulate  # noqa: E402

START = 1_767_225_600_000_000_000
"""The first stamp, in nanoseconds since the epoch."""

TELEMETRY_EVERY = 200_000_000
WARNED = 25
"""A vehicle warns once per this number of its telemetry messages."""

ITS_EPOCH = 1_072_915_200_000 - 5_000
"""2004-01-01 in milliseconds since the Unix epoch, and the leap seconds since, which ITS time counts."""

BAD_EVERY = 60 * 10**9
"""Each kind of bad sample is sent once per this number of nanoseconds."""

LATENESS = 10
"""Seconds, as in the Detector."""

FLUSH = 20
"""Seconds that the clock advances without samples, so that everything before is evaluated."""

CAMERAS = 2
"""Number of vehicles with a camera."""

SIDE = 8
"""Pixels of an image's side."""

OVER_MQTT = "mileage"
"""The stream that comes over MQTT."""


@dataclass
class Sent:
    """What was sent: by stream what must be taken in, by cause and stream what must be dropped."""

    samples: Counter[str] = field(default_factory=Counter)
    dropped: Counter[tuple[str, str]] = field(default_factory=Counter)


def traffic(seed: int, start_ns: int, seconds: int, sent: Sent) -> Iterator[tuple[int, str, bytes]]:
    """Nanoseconds after the start, key and payload of each message, in order; `sent` is filled on the way."""
    drive = simulate(seed, horizon_s=seconds)
    telemetry = _telemetry(start_ns)
    bad = _bad(start_ns)
    following, wrong = next(telemetry), next(bad)
    for message in messages(drive, start_ns, seconds):
        while following[0] <= message.after_ns:
            sent.samples[following[1].rsplit("/", 1)[-1]] += 1
            yield following
            following = next(telemetry)
        while wrong[0] <= message.after_ns:
            at, cause, key, payload = wrong
            stream = "" if cause in ("ahead", "late") else "telemetry"
            sent.dropped[cause, stream] += 1
            yield at, key, payload
            wrong = next(bad)
        sent.samples[message.key.rsplit("/", 1)[-1]] += 1
        yield message.after_ns, message.key, message.payload
    for tenth in range(FLUSH * 10):
        after = seconds * 10**9 + tenth * 10**8
        yield after, "clock/clock", json.dumps({"t": (start_ns + after) / 1e9}).encode()


def _telemetry(start_ns: int) -> Iterator[tuple[int, str, bytes]]:
    step = 0
    while True:
        after = step * TELEMETRY_EVERY
        for number, vehicle in enumerate(VEHICLES):
            speed = 14 + 6 * math.sin(after / 17e9 + number)
            values = {
                "t": (start_ns + after) / 1e9,
                "v": round(speed, 3),
                "brake": math.sin(after / 5e9 + number) > 0.8,
                "mode": ("auto", "manual", None)[(after // 20_000_000_000 + number) % 3],
                "counter": 2**53 + after,
                "seen": [{"x": 5, "y": 0}, {"x": 0, "y": 9}],
                # For ten seconds of each minute, one of the two objects is not tracked.
                "tracked": [{"x": 5.3, "y": 0}, {"x": 0, "y": 99 if after % 60_000_000_000 < 10_000_000_000 else 9}],
            }
            yield after, f"vehicles/{vehicle.name}/telemetry", json.dumps(values).encode()
            if step % WARNED == number:
                yield after, f"vehicles/{vehicle.name}/warning", _warning(start_ns + after, number)
            if step % 5 == 0:
                battery = 50 + 45 * math.sin(after / 60e9 + number)
                status = {"t": (start_ns + after) / 1e9, "battery": battery}
                yield after, f"vehicles/{vehicle.name}/status", cbor2.dumps(status)
                mileage = {"t": (start_ns + after) / 1e9, "km": after / 1e11 + number}
                yield after, f"vehicles/{vehicle.name}/{OVER_MQTT}", json.dumps(mileage).encode()
                if number < CAMERAS:
                    yield after, f"vehicles/{vehicle.name}/camera", _image(start_ns + after)
        step += 1


def _image(now: int) -> bytes:
    """For twenty seconds of each minute it is white, else black."""
    brightness = 255 if now % (60 * 10**9) < 20 * 10**9 else 0
    image = _IMAGE(
        header=_HEADER(stamp=_TIME(sec=now // 10**9, nanosec=now % 10**9), frame_id="camera"),
        height=SIDE,
        width=SIDE,
        encoding="mono8",
        is_bigendian=0,
        step=SIDE,
        data=np.full(SIDE * SIDE, brightness, np.uint8),
    )
    return bytes(_TYPES.serialize_cdr(image, _IMAGE.__msgtype__))


def _warning(now: int, number: int) -> bytes:
    """A DENM: for twenty seconds of each minute the events are close together."""
    time = now // 1_000_000 - ITS_EPOCH
    apart = 100 if now % (60 * 10**9) < 20 * 10**9 else 10_000
    DENM.set_val(
        {
            "header": {"protocolVersion": 2, "messageID": 1, "stationID": number},
            "denm": {
                "management": {
                    "actionID": {"originatingStationID": number, "sequenceNumber": 1},
                    "detectionTime": time,
                    "referenceTime": time,
                    "eventPosition": {
                        "latitude": 507_770_000,
                        "longitude": 61_000_000 + number * apart,
                        "positionConfidenceEllipse": {
                            "semiMajorConfidence": 100,
                            "semiMinorConfidence": 100,
                            "semiMajorOrientation": 900,
                        },
                        "altitude": {"altitudeValue": 20_000, "altitudeConfidence": "unavailable"},
                    },
                    "stationType": 5,
                }
            },
        }
    )
    return bytes(DENM.to_uper())


def _bad(start_ns: int) -> Iterator[tuple[int, str, str, bytes]]:
    """In turn: no JSON, a key without a valid client, a clock an hour ahead, and one that is ten minutes behind."""
    key = f"vehicles/{VEHICLES[0].name}/telemetry"
    number = 0
    while True:
        number += 1
        after = number * BAD_EVERY // 4
        now = (start_ns + after) / 1e9
        cause = ("undecodable", "unnamed", "ahead", "late")[number % 4]
        payload = {
            "undecodable": b'{"t": ',
            "unnamed": json.dumps({"t": now}).encode(),
            "ahead": json.dumps({"t": now + 3600, "v": 0}).encode(),
            "late": json.dumps({"t": now - 600, "v": 0}).encode(),
        }[cause]
        yield after, cause, "vehicles/not!valid/telemetry" if cause == "unnamed" else key, payload
