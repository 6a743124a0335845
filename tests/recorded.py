"""The messages of recordings, and JSON lines as users write them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from detector.engine.samples.sample import Arrival
from detector.replay.batches import batched, messages_of
from detector.replay.message import Message, Truncation, ignore
from detector.replay.recordings import open_recordings
from detector.replay.routing import MessageRouter


def messages_in(
    paths: Sequence[Path],
    wanted: Callable[[str], bool] = lambda key: True,
    on_cut: Callable[[Truncation], None] = ignore,
) -> Iterator[Message]:
    """The messages of the recordings. Raises RecordingError at once where one is missing or of no known kind."""
    return messages_of(open_recordings(paths, wanted, on_cut))


def arrivals_of(router: MessageRouter, messages: Iterable[Message]) -> Iterator[Arrival]:
    """The arrivals that the router makes of the messages."""
    return chain.from_iterable(router.arrivals(batched(messages)))


def write_json_lines(path: Path, messages: Iterable[tuple[int, str, Any]]) -> Path:
    """The file, with a line for the time (nanoseconds), key and value of each message."""
    with path.open("w") as file:
        file.writelines(json.dumps({"t": time, "key": key, "value": value}) + "\n" for time, key, value in messages)
    return path
