"""results.mcap: the evaluation, to open beside the recording in Foxglove or Lichtblick; and a layout file for it.

The layout shows the scene, conditions, values with their thresholds, and the log.
"""

from __future__ import annotations

import operator
from pathlib import Path
from typing import Any

import foxglove
import msgspec
from foxglove import layouts
from foxglove.channels import LogChannel, SceneUpdateChannel

from detector.results.channels import (
    EPISODE,
    EPISODES,
    LOG,
    SCENE,
    episode_message,
    log_message,
    message_path,
    subject_channel,
    topic_of,
)
from detector.results.result import Result
from detector.results.scene import FRAME, Scene
from detector.results.series import SeriesKind, SubjectTrace

MOST = 200_000
"""Approximate maximum number of messages with values: longer series are reduced to minima and maxima of periods."""


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


_SUBJECTS = 3
"""Maximum number of subjects of a rule with plotted values: those with most episodes."""


def layout_of(result: Result) -> str:
    """The layout as JSON, for Foxglove's *Import from file*."""
    chosen = _chosen(result)
    states = [
        layouts.StateTransitionsSeries(value=f"{_quoted(each)}.{field}", label=f"{each.rule} {each.subject} {field}")
        for each in chosen
        for field in each.conditions
    ]
    plots: list[layouts.Content] = []
    for rule in dict.fromkeys(each.rule for each in chosen):
        series = [one for each in chosen if each.rule == rule for one in _series(result, each)]
        if series:
            plots.append(layouts.PlotPanel(title=rule, config=layouts.PlotConfig(paths=series)))
    scene = layouts.ThreeDeePanel(config=layouts.ThreeDeeConfig(follow_tf=FRAME))
    right = [layouts.StateTransitionsPanel(config=layouts.StateTransitionsConfig(paths=states)), *plots[:4]]
    left = [scene, layouts.LogPanel(config=layouts.LogConfig(topic_to_render="/wayside/log"))]
    columns = [
        layouts.SplitContainer(
            direction="column", items=[layouts.SplitItem(proportion=1, content=panel) for panel in panels]
        )
        for panels in (left, right)
    ]
    content = layouts.SplitContainer(
        direction="row", items=[layouts.SplitItem(proportion=1, content=column) for column in columns]
    )
    return layouts.Layout(content=content).to_json()


def _chosen(result: Result) -> list[SubjectTrace]:
    counts: dict[tuple[str, str], int] = {}
    for event in result.events:
        if event.started:
            key = event.episode.rule, event.episode.subject
            counts[key] = counts.get(key, 0) + 1
    found: list[SubjectTrace] = []
    for rule in dict.fromkeys(each.rule for each in result.trace.subjects):
        own = [each for each in result.trace.subjects if each.rule == rule]
        own.sort(key=lambda each: (-counts.get((rule, each.subject), 0), each.subject))
        found += own[:_SUBJECTS]
    return found


def _series(result: Result, subject: SubjectTrace) -> list[layouts.PlotSeries]:
    terms = result.terms.get((subject.rule, subject.subject))
    named = {**subject.signals, **(terms.computed if terms is not None else {})}
    found = [
        layouts.PlotSeries(
            value=f"{_quoted(subject)}.{'.'.join(message_path(name))}", label=f"{subject.subject} {name}"
        )
        for name, series in named.items()
        if series.kind is SeriesKind.NUMBER
    ]
    for each in terms.thresholds if terms is not None else ():
        path = ".".join(("threshold", each.field, *message_path(each.term)))
        label = f"{subject.subject} {each.field}: {each.operator} {each.value:g}"
        found.append(layouts.PlotSeries(value=f"{_quoted(subject)}.{path}", label=label))
    return found


def _quoted(subject: SubjectTrace) -> str:
    """The topic in a message path; quoted, because it contains characters of the path's syntax."""
    return f'"{topic_of(subject.rule, subject.subject)}"'
