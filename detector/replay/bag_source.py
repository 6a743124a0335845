"""The plugin `bag`: plays recordings into the running detector, at their original or another speed."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import BaseModel, Field

from detector.replay.batches import messages_of
from detector.replay.gathering import recording_name, recording_paths
from detector.replay.recordings import open_recordings
from detector.replay.routing import MessageRouter
from detector.sources.base import Feed, Source
from wayside.api.base import Model

_log = logging.getLogger(__name__)

_LONGEST_WAIT = 0.5
"""Maximum seconds between two checks of whether to stop."""


class BagParameters(Model):
    """The recordings to play, and how."""

    paths: list[Annotated[str, Field(min_length=1, max_length=1024)]] = Field(
        min_length=1,
        max_length=16,
        description="The recordings: rosbag2 folders, ROS 1 bags, MCAP files, JSON lines, or folders and patterns of "
        "these. They are played as one.",
    )
    rate: float = Field(default=1.0, gt=0, le=1000, description="How many times as fast as recorded.")
    loop: bool = Field(default=False, description="Whether to restart at the end.")


class BagSource(Source[BagParameters]):
    """Plays recordings as if they happened now: with clock Wall, a message is received when it is played."""

    Parameters: ClassVar[type[BaseModel]] = BagParameters

    def run(self, feed: Feed) -> None:
        """Play to the end. Raises RecordingError if a recording is missing, damaged, or does not fit a stream."""
        while not feed.stopping:
            self._play(feed)
            if not self.parameters.loop:
                return
            feed.wait(0.01)  # looping over an empty recording must not keep the processor busy

    def _play(self, feed: Feed) -> None:
        paths = recording_paths(Path(path) for path in self.parameters.paths)
        router = MessageRouter([stream.spec for stream in feed.streams], recording_name(tuple(paths)))
        recordings = open_recordings(paths, router.wanted, lambda cut: _log.warning("%s", cut))
        first: int | None = None
        began = time.monotonic()
        for message in messages_of(router.routed(recordings)):
            if first is None:
                first, began = message.time, time.monotonic()
            due = began + (message.time - first) / 1e9 / self.parameters.rate
            while (ahead := due - time.monotonic()) > 0:
                if feed.wait(min(ahead, _LONGEST_WAIT)):
                    return
            if feed.stopping:
                return
            feed.put(message.key, message.payload)
