"""The transform tree of each client, from the tf2_msgs/msg/TFMessage samples in the buffer.

A transform gives the pose of a child frame in its parent frame at its stamp. Between two transforms it is interpolated;
before the first and after the last it is unknown. When a frame changes its parent, the last transform stays valid until
then. On a latched stream (/tf_static) a transform is valid at all times, and the one with the newest stamp is used.
"""

from __future__ import annotations

import difflib
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from detector.engine.buffering.buffer import Buffer
from detector.engine.buffering.messages import Messages
from detector.engine.counters import Counters
from detector.engine.queries.geometry import NO_MOTION, Pose, PoseError, pose_in
from detector.engine.samples.sample import Sample
from wayside.expressions import UNKNOWN

_CLIENT = "${client}"

_CACHE_DURATION = 10_000_000_000
"""Nanoseconds for which transforms stay cached after their last use."""


class TransformError(LookupError):
    """A transform is not known; the text names the reason."""


@dataclass(frozen=True, slots=True)
class TransformStream:
    """A stream that carries transforms."""

    name: str
    static: bool
    """Whether its transforms are valid at all times."""
    prefix: str
    """The prefix that is removed from the names of frames; `${client}` in it stands for the client's name."""


class Link(NamedTuple):
    """The pose of a frame in its parent."""

    stamp: int
    parent: str
    pose: Pose


_Parsed = dict[str, list[Link]]
"""The transforms of one sample, by their child frames."""


class Transforms:
    """Looks up transforms between frames. Samples are parsed once, on first use."""

    def __init__(
        self, streams: Sequence[TransformStream], buffer: Buffer, messages: Messages, counters: Counters
    ) -> None:
        self._streams = streams
        self._buffer = buffer
        self._messages = messages
        self._counters = counters
        self._parsed: dict[tuple[str, str], dict[Sample, _Parsed]] = {}
        """By client and stream; only samples in the buffer."""
        self._used: dict[tuple[str, str], int] = {}
        """By client and stream, when `_parsed` was last used; nanoseconds."""
        self._trees: dict[str, _Tree] = {}
        """The trees of the current tick."""

    def forget(self, now: int) -> None:
        """The tick is over. Drop entries without recent use: they may refer to samples that the buffer has
        dropped."""
        self._trees.clear()
        for place in [place for place, used in self._used.items() if not 0 <= now - used <= _CACHE_DURATION]:
            del self._used[place], self._parsed[place]

    def lookup(self, client: str, target: str, source: str, stamp: int | None, now: int) -> Pose:
        """See Queries.transform; `now` is the tick. Raises TransformError."""
        target, source = self._name(client, target), self._name(client, source)
        if target == source:
            return NO_MOTION
        tree = self._trees.get(client)
        if tree is None:
            tree = self._trees[client] = self._tree(client, now)
        return tree.lookup(target, source, stamp)

    def _tree(self, client: str, now: int) -> _Tree:
        fixed: list[_Parsed] = []
        moving: list[_Parsed] = []
        for stream in self._streams:
            (fixed if stream.static else moving).extend(self._read(client, stream, now))
        return _Tree(client, fixed, moving, now)

    def _read(self, client: str, stream: TransformStream, now: int) -> Iterator[_Parsed]:
        """The transforms in the samples up to `now`, oldest first."""
        lane = self._buffer.lane(client, stream.name)
        known = self._parsed.get((client, stream.name), {})
        kept: dict[Sample, _Parsed] = {}
        for sample in () if lane is None else reversed(list(lane.newest_first(None, now))):
            parsed = known.get(sample)
            if parsed is None:
                parsed = self._parse(client, stream, sample)
            kept[sample] = parsed
            yield parsed
        self._parsed[client, stream.name] = kept
        self._used[client, stream.name] = now

    def _parse(self, client: str, stream: TransformStream, sample: Sample) -> _Parsed:
        message = self._messages.message(stream.name, sample)
        links: _Parsed = {}
        if message is UNKNOWN:
            return links
        for transform in message["transforms"]:
            try:
                pose = pose_in(transform, "transform")
            except PoseError as error:
                self._counters.undecodable[stream.name] += 1
                self._counters.last_undecodable[stream.name] = f"{sample.key}: {error}"
                continue
            header: dict[str, Any] = transform["header"]
            link = Link(_nanoseconds(header["stamp"]), self._name(client, header["frame_id"]), pose)
            links.setdefault(self._name(client, transform["child_frame_id"]), []).append(link)
        return links

    def _name(self, client: str, frame: str) -> str:
        """The frame's name without a leading slash (ROS 1) and without the client's prefix."""
        frame = frame.removeprefix("/")
        for stream in self._streams:
            prefix = stream.prefix.replace(_CLIENT, client)
            if prefix and frame.startswith(prefix):
                return frame.removeprefix(prefix)
        return frame


class _Tree:
    """The transforms of one client at one tick."""

    def __init__(self, client: str, fixed: Sequence[_Parsed], moving: Sequence[_Parsed], now: int) -> None:
        self._client = client
        self._fixed = fixed
        self._moving = moving
        self._now = now
        self._links: dict[str, tuple[Link | None, list[Link]]] = {}

    def lookup(self, target: str, source: str, stamp: int | None) -> Pose:
        """The pose of source in target; raises TransformError."""
        if stamp is None:
            stamp = self._newest_common(target, source)
        ups, downs = self._path(target, source, stamp)
        there, back = NO_MOTION, NO_MOTION
        for frame in ups:
            there = self._pose(frame, stamp).after(there)
        for frame in downs:
            back = self._pose(frame, stamp).after(back)
        return back.inverse().after(there)

    def _newest_common(self, target: str, source: str) -> int:
        """The newest time at which all moving transforms on the path are known; the tick if none moves."""
        ups, downs = self._path(target, source, self._now)
        return min((links[-1].stamp for frame in (*ups, *downs) if (links := self._of(frame)[1])), default=self._now)

    def _path(self, target: str, source: str, stamp: int) -> tuple[list[str], list[str]]:
        """The frames from source, and from target, to just below their closest common ancestor."""
        ups, downs = self._upwards(source, stamp), self._upwards(target, stamp)
        common = next((frame for frame in ups if frame in downs), None)
        if common is not None:
            return ups[: ups.index(common)], downs[: downs.index(common)]
        frames = self._frames()
        for frame in (target, source):
            if frame not in frames:
                raise TransformError(f"client {self._client} has no frame {frame!r}: {_hint(frame, frames)}")
        raise TransformError(
            f"frames {target!r} and {source!r} of client {self._client} are not connected: "
            f"one chain ends at {downs[-1]!r}, the other at {ups[-1]!r}"
        )

    def _upwards(self, frame: str, stamp: int) -> list[str]:
        """The frame and its ancestors."""
        chain = [frame]
        while (parent := self._parent(chain[-1], stamp)) is not None:
            if parent in chain:
                raise TransformError(f"the transforms of client {self._client} form a cycle at frame {parent!r}")
            chain.append(parent)
        return chain

    def _parent(self, frame: str, stamp: int) -> str | None:
        fixed, links = self._of(frame)
        if not links:
            return None if fixed is None else fixed.parent
        return links[max(bisect_right(links, stamp, key=_stamp_of) - 1, 0)].parent

    def _pose(self, frame: str, stamp: int) -> Pose:
        """The pose of the frame in its parent at that time."""
        fixed, links = self._of(frame)
        if not links:
            assert fixed is not None  # noqa: S101  only frames with a parent get here
            return fixed.pose
        after = bisect_right(links, stamp, key=_stamp_of)
        if after == 0 or (after == len(links) and links[-1].stamp < stamp):
            beyond = links[0].stamp - stamp if after == 0 else stamp - links[-1].stamp
            side = "before the first" if after == 0 else "after the last"
            raise TransformError(
                f"client {self._client} has no transform from frame {links[-1].parent!r} to {frame!r} at "
                f"{_text(stamp)}, which is {beyond / 1e9:.3f} s {side} transform: these frames have transforms from "
                f"{_text(links[0].stamp)} to {_text(links[-1].stamp)}"
            )
        before = links[after - 1]
        if before.stamp == stamp or after == len(links) or links[after].parent != before.parent:
            return before.pose
        following = links[after]
        return before.pose.towards(following.pose, (stamp - before.stamp) / (following.stamp - before.stamp))

    def _of(self, frame: str) -> tuple[Link | None, list[Link]]:
        """The frame's static transform, and its moving ones sorted by stamp."""
        known = self._links.get(frame)
        if known is None:
            fixed = [link for parsed in self._fixed if frame in parsed for link in parsed[frame]]
            moving = [link for parsed in self._moving if frame in parsed for link in parsed[frame]]
            moving.sort(key=_stamp_of)
            last = max(enumerate(fixed), key=lambda each: (each[1].stamp, each[0]), default=(0, None))[1]
            known = self._links[frame] = last, moving
        return known

    def _frames(self) -> set[str]:
        frames: set[str] = set()
        for parsed in (*self._fixed, *self._moving):
            frames.update(parsed, (link.parent for links in parsed.values() for link in links))
        return frames


def _stamp_of(link: Link) -> int:
    return link.stamp


def _nanoseconds(stamp: dict[str, float]) -> int:
    return int(stamp["sec"]) * 10**9 + int(stamp["nanosec"])


def _text(stamp: int) -> str:
    return f"{stamp // 10**9}.{stamp % 10**9:09d}"


def _hint(frame: str, frames: set[str]) -> str:
    if not frames:
        return "no transforms of it have arrived (streams of type tf2_msgs/msg/TFMessage)"
    close = difflib.get_close_matches(frame, frames, n=1)
    return f"did you mean {close[0]!r}?" if close else f"it has {', '.join(sorted(frames)[:20])}"
