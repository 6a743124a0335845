"""The clients, the pairs and the places of a recording in Foxglove's 3D panel."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from foxglove.messages import (
    Color,
    Duration,
    LinePrimitive,
    LinePrimitiveLineType,
    Point3,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    SpherePrimitive,
    TextPrimitive,
    Timestamp,
    Vector3,
)

from detector.engine.episodes.events import Event
from detector.engine.episodes.record import EpisodeRecord
from detector.results.result import Result, polygons_of
from detector.results.series import Doubles

FRAME = "map"
"""The frame of all positions: the frame of the rule's position."""

_STEP = 200_000_000
"""Minimum nanoseconds between updates of the scene, except at starts and ends of episodes."""
_MOST = 2000
"""Maximum number of further updates."""
_KEPT = 1_000_000_000
"""Nanoseconds for which a client is shown after its last place."""
_EARTH = 6_371_000.0
_CLIENT, _OPEN, _PLACE = (0.15, 0.45, 0.8, 1.0), (0.85, 0.25, 0.2, 1.0), (0.4, 0.6, 0.3, 0.9)


class Scene:
    """The scene over time. Degrees are converted to metres from the first place."""

    def __init__(self) -> None:
        self._origin: Doubles | None = None
        self._busy: dict[str, EpisodeRecord] = {}
        """The open episodes."""

    def updates(self, result: Result) -> Iterator[tuple[int, SceneUpdate]]:
        """The updates of a result, which follows the previous one; nothing if no position is known."""
        trace, events = result.trace, deque(result.events)
        if not trace.paths:
            self._advance(events, trace.end)
            return
        if self._origin is None:
            self._origin = next(iter(trace.paths.values())).axes[:, 0]
        origin = self._origin
        step = max(_STEP, (trace.end - trace.begin) // _MOST)
        at_events = np.array([event.time for event in events], np.int64)
        times = np.unique(np.concatenate((np.arange(trace.begin, trace.end + 1, step), at_events)))
        flat = {name: _metres(path.axes, origin, geographic=trace.geographic) for name, path in trace.paths.items()}
        rows = {name: np.searchsorted(path.times, times, "right") - 1 for name, path in trace.paths.items()}
        last = {name: int(path.times[-1]) for name, path in trace.paths.items()}
        yield int(times[0]), SceneUpdate(entities=[*_polygons(result, int(times[0]), origin)])
        for at, time in enumerate(times.tolist()):
            self._advance(events, time)
            there: dict[str, tuple[float, float]] = {}
            for name, axes in flat.items():
                row = int(rows[name][at])
                if row >= 0 and time <= last[name] + _KEPT:
                    there[name] = float(axes[0, row]), float(axes[1, row])
            yield time, SceneUpdate(entities=self._entities(there, time))

    def skip(self, result: Result) -> None:
        """Skip this result: only track which episodes are open after it."""
        self._advance(deque(result.events), result.trace.end)

    def _advance(self, events: deque[Event], time: int) -> None:
        """Update the open episodes to this time."""
        while events and events[0].time <= time:
            event = events.popleft()
            if event.started:
                self._busy[event.episode.id] = event.episode
            else:
                self._busy.pop(event.episode.id, None)

    def _entities(self, there: Mapping[str, tuple[float, float]], time: int) -> list[SceneEntity]:
        named: dict[str, list[str]] = {}
        pairs = []
        for each in self._busy.values():
            if len(each.clients) == 1:
                named.setdefault(each.clients[0], []).append(each.rule)
            elif len(each.clients) == 2 and there.keys() >= {*each.clients}:
                pairs.append(_pair(each.rule, each.clients, there, time))
        return [_client(name, place, named.get(name, ()), time) for name, place in there.items()] + pairs


def _metres(axes: Doubles, origin: Doubles, *, geographic: bool) -> Doubles:
    if not geographic:
        return axes
    north = np.radians(axes[0] - origin[0]) * _EARTH
    east = np.radians(axes[1] - origin[1]) * _EARTH * math.cos(math.radians(origin[0]))
    return np.stack((east, north))


def _entity(name: str, time: int, **primitives: Any) -> SceneEntity:
    """Valid until it is updated, at most for two seconds."""
    return SceneEntity(timestamp=_stamp(time), frame_id=FRAME, id=name, lifetime=Duration(sec=2), **primitives)


def _client(name: str, place: tuple[float, float], rules: Sequence[str], time: int) -> SceneEntity:
    """A client; in an episode it has another colour, and its label names the rules."""
    color = _OPEN if rules else _CLIENT
    sphere = SpherePrimitive(pose=_pose(*place), size=Vector3(x=3.0, y=3.0, z=3.0), color=_color(color))
    text = f"{name}: {', '.join(rules)}" if rules else name
    return _entity(f"client {name}", time, spheres=[sphere], texts=[_label(text, place, 3.0, color)])


def _pair(rule: str, pair: tuple[str, ...], there: Mapping[str, tuple[float, float]], time: int) -> SceneEntity:
    (x, y), (u, v) = (there[name] for name in pair)
    line = LinePrimitive(
        type=LinePrimitiveLineType.LineStrip,
        pose=_pose(0.0, 0.0),
        thickness=3.0,
        scale_invariant=True,
        points=[Point3(x=x, y=y, z=1.0), Point3(x=u, y=v, z=1.0)],
        color=_color(_OPEN),
    )
    text = _label(f"{rule}: {math.hypot(x - u, y - v):.0f} m", ((x + u) / 2, (y + v) / 2), 4.0, _OPEN)
    return _entity(f"{rule} {'+'.join(pair)}", time, lines=[line], texts=[text])


def _polygons(result: Result, time: int, origin: Doubles) -> Iterator[SceneEntity]:
    for polygon in polygons_of(result.rules.values()):
        corners = np.array(polygon.corners, float).T
        if polygon.geographic != result.trace.geographic:
            continue
        flat = _metres(corners, origin, geographic=polygon.geographic)
        line = LinePrimitive(
            type=LinePrimitiveLineType.LineLoop if polygon.closed else LinePrimitiveLineType.LineStrip,
            pose=_pose(0.0, 0.0),
            thickness=2.0,
            scale_invariant=True,
            points=[Point3(x=float(x), y=float(y), z=0.0) for x, y in flat.T],
            color=_color(_PLACE),
        )
        text = _label(polygon.name, (float(flat[0].mean()), float(flat[1].mean())), 0.5, _PLACE)
        yield SceneEntity(
            timestamp=_stamp(time),
            frame_id=FRAME,
            id=f"{polygon.rule} {polygon.name}{'' if polygon.closed else ' line'}",
            lines=[line],
            texts=[text],
        )


def _label(text: str, place: tuple[float, float], above: float, color: tuple[float, ...]) -> TextPrimitive:
    return TextPrimitive(
        pose=_pose(*place, above), billboard=True, font_size=12.0, scale_invariant=True, color=_color(color), text=text
    )


def _pose(x: float, y: float, z: float = 0.0) -> Pose:
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=0.0, y=0.0, z=0.0, w=1.0))


def _color(color: tuple[float, ...]) -> Color:
    return Color(r=color[0], g=color[1], b=color[2], a=color[3])


def _stamp(time: int) -> Timestamp:
    return Timestamp(sec=time // 1_000_000_000, nsec=time % 1_000_000_000)
