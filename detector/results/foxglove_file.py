"""results.mcap: the evaluation, to open beside the recording in Foxglove or Lichtblick."""

from __future__ import annotations

import operator
from pathlib import Path
from typing import Any

import foxglove
import msgspec
from foxglove.channels import LogChannel, SceneUpdateChannel

from detector.results.channels import (
    EPISODE,
    EPISODES,
    LOG,
    SCENE,
    episode_message,
    log_message,
    subject_channel,
    topic_of,
)
from detector.results.result import Result
from detector.results.scene import Scene

MOST = 200_000
"""Approximate maximum number of messages with values: longer series are reduced to minimum and maximum of equal
periods."""


def write_mcap(path: Path, result: Result) -> None:
    """Write the file; an existing one is replaced."""
    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context, allow_overwrite=True):
        messages: list[tuple[int, int, Any]] = []
        writers: list[Any] = []
        series = sum(len(each.signals) for each in result.trace.subjects)
        buckets = max(20, MOST // (2 * max(series, 1)))
        for subject in result.trace.subjects:
            schema, found = subject_channel(result, subject, buckets)
            topic = topic_of(subject.rule, subject.subject)
            writers.append(foxglove.Channel(topic, schema=schema, message_encoding="json", context=context))
            messages += ((time, len(writers) - 1, payload) for time, payload in found)
        episodes = foxglove.Channel(EPISODES, schema=EPISODE, message_encoding="json", context=context)
        log, scene = LogChannel(LOG, context=context), SceneUpdateChannel(SCENE, context=context)
        writers += [episodes, log, scene]
        for event in result.events:
            time = event.time
            messages.append((time, len(writers) - 3, msgspec.json.encode(episode_message(event))))
            messages.append((time, len(writers) - 2, log_message(event, time)))
        messages += ((time, len(writers) - 1, update) for time, update in Scene().updates(result))
        messages.sort(key=operator.itemgetter(0, 1))
        for time, number, message in messages:
            writers[number].log(message, log_time=time)
