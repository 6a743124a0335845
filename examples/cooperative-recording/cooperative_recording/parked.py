"""Vehicles that stay at the positions set last, to look at one step after the other.

They send what moving vehicles send, as often: a pose ten times a second, a point cloud twice a second.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Sequence
from types import TracebackType

import zenoh

from cooperative_recording.messages import points_key, points_payload, pose_key, pose_payload
from cooperative_recording.publish import open_session
from cooperative_recording.vehicles import LIDAR_VEHICLES, Pose

_PERIOD_S = 0.1
_CLOUD_EVERY = 5
"""Poses to one cloud."""
_BY_NAME = {vehicle.name: vehicle for vehicle in LIDAR_VEHICLES}


class ParkedVehicles:
    """Inside the `with`, vehicles with a lidar stand on one line, from west to east."""

    def __init__(self, connect: Sequence[str] | zenoh.Session, wait_s: float = 10.0) -> None:
        """Connect to these Zenoh endpoints, or send through a session, which is closed at the end.

        Raises UnreachableError where no endpoint answers within `wait_s` seconds.
        """
        self._session = connect if isinstance(connect, zenoh.Session) else open_session(connect, (), wait_s)
        self._places: dict[str, float] = {}
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="vehicles", daemon=True)

    def put(self, vehicle: str, x: float) -> None:
        """Put the vehicle (KeyError: none with a lidar has that name) `x` metres to the east of the middle."""
        _ = _BY_NAME[vehicle]
        with self._lock:
            self._places[vehicle] = x

    def __enter__(self) -> ParkedVehicles:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()
        self._session.close()  # type: ignore[no-untyped-call]

    def _run(self) -> None:
        for number in itertools.count():
            if self._ended.wait(_PERIOD_S):
                return
            with self._lock:
                places = dict(self._places)
            for name, x in places.items():
                vehicle, now = _BY_NAME[name], time.time_ns()
                self._session.put(pose_key(vehicle), pose_payload(Pose(x, 0.0, 0.0, 0.0), now))
                if number % _CLOUD_EVERY == 0:
                    self._session.put(points_key(vehicle), points_payload(vehicle, 0, number, now))
