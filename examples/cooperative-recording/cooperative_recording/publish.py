"""The drive live, over Zenoh, at its own pace."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass

import zenoh

from cooperative_recording.messages import keys, messages
from cooperative_recording.vehicles import Drive


class UnreachableError(Exception):
    """No Zenoh session could be opened with these endpoints."""


@dataclass(frozen=True, slots=True)
class Published:
    """The published drive: stamps begin at start_ns; lag_s is the delay of the latest message, in seconds."""

    start_ns: int
    messages: int
    bytes: int
    lag_s: float
    listened: bool
    complete: bool


def publish(
    drive: Drive,
    duration_s: float,
    *,
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    start_ns: int | None = None,
    speed: float = 1.0,
    wait_s: float = 10.0,
    stop: threading.Event | None = None,
) -> Published:
    """Publish the drive's first duration_s seconds, speed times as fast as it happens.

    The drive begins once somebody subscribes to the poses, or after wait_s seconds without. Its stamps begin with
    start_ns (nanoseconds since the epoch), by default with the clock's time at that moment; for a start_ns at most a
    minute ahead it waits until then. Once `stop` is set it ends within a tenth of a second.

    Vehicles never wait for their listeners: what the send queue cannot take is dropped. Messages are not sent as
    `express`: without batches the queue holds so few of them that a busy machine's hiccup of some milliseconds loses
    poses (with both cores busy in 16 of 25 drives; in none with batches).

    Raises:
        UnreachableError: no session could be opened within wait_s.
    """
    stop = stop or threading.Event()
    with open_session(connect, listen, wait_s) as session:
        publishers = {
            key: session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP) for key in keys()
        }
        patience = time.monotonic() + wait_s
        poses = [publisher for key, publisher in publishers.items() if key.endswith("/pose")]
        while not (listened := all(map(_has_listener, poses))):
            if time.monotonic() >= patience or stop.wait(0.02):
                break
        if start_ns is None:
            start_ns = time.time_ns()
        elif 0 < (ahead := start_ns - time.time_ns()) <= 60 * 10**9:
            stop.wait(ahead / 1e9)
        begin = time.monotonic()
        count = size = 0
        lag = 0.0
        for message in messages(drive, start_ns, duration_s):
            due = begin + message.after_ns / 1e9 / speed
            while (early := due - time.monotonic()) > 0 and not stop.is_set():
                stop.wait(min(early, 0.1))
            if stop.is_set():
                break
            publishers[message.key].put(message.payload)
            count, size, lag = count + 1, size + len(message.payload), max(lag, -early)
        else:
            stop.wait(max(0.0, begin + duration_s / speed - time.monotonic()))
    return Published(start_ns, count, size, lag, listened, not stop.is_set())


def _has_listener(publisher: zenoh.Publisher) -> bool:
    return bool(publisher.matching_status.matching)  # type: ignore[attr-defined]  # zenoh's stub takes it for a bool


def open_session(connect: Sequence[str], listen: Sequence[str], wait_s: float) -> zenoh.Session:
    """A session with these endpoints. Raises UnreachableError where there is none within `wait_s` seconds."""
    config = zenoh.Config()
    settings = {
        "mode": "peer",
        "connect/endpoints": list(connect),
        "connect/timeout_ms": round(wait_s * 1000),
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 200, "period_increase_factor": 1},
        "listen/endpoints": list(listen),
        "listen/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        "transport/link/tx/queue/size/data": 16,  # the most there is
    }
    try:
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = " ".join([*(f"--connect {end}" for end in connect), *(f"--listen {end}" for end in listen)])
        reason = str(error).split(" at /")[0]  # without the place in Zenoh's sources
        raise UnreachableError(
            f"{where}: no Zenoh session within {wait_s:g} s: give an endpoint such as tcp/127.0.0.1:7447, and start "
            f"what listens there first ({reason})"
        ) from error
