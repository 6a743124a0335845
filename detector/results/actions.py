"""The actions that would have run: the applications demanded over time, and the data passed on."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import NamedTuple

from detector.results.episodes import EpisodeRow
from detector.results.result import Result
from wayside.times import parse_time


class Deed(NamedTuple):
    """One action for one episode. Times are nanoseconds since the epoch."""

    rule: str
    action: str
    subject: str
    what: str
    """`deploy`, `record`, `database` and so on."""
    about: str
    """The template with its parameters, or the streams."""
    begin: int
    end: int | None
    """None: still running at the end of the recording."""


def deeds_of(result: Result) -> list[Deed]:
    """The actions that would have run, in time order."""
    found = [*_tasks(result), *_windows(result)]
    return sorted(found, key=lambda deed: (deed.begin, deed.rule, deed.subject, deed.action))


def _tasks(result: Result) -> Iterator[Deed]:
    for task in result.tasks:
        event, spec = task.spec.event, task.spec
        if event is None:
            continue
        parameters = ", ".join(f"{name}={json.dumps(value)}" for name, value in spec.parameters.items())
        about = f"{spec.template_name}: {parameters}" if parameters else spec.template_name
        end = None if spec.end_time is None else parse_time(spec.end_time)
        begin = parse_time(event.start_time)
        yield Deed(event.rule, event.action, event.subject, str(spec.operation).lower(), about, begin, end)


def _windows(result: Result) -> Iterator[Deed]:
    for episode in result.episodes:
        rule = result.rules.get(episode.rule)
        if rule is None or rule.dry_run:
            continue
        for action in rule.actions:
            kind = next((key for key in json.loads(action.source) if key != "name"), "action")
            if action.window is None:
                yield Deed(rule.name, action.name, episode.subject, kind, "", episode.start_time, episode.end_time)
                continue
            window = action.window
            begin = episode.onset_time - window.before_ns
            end = _after(episode, window.after_ns)
            about = ", ".join(sorted(window.streams))
            yield Deed(rule.name, action.name, episode.subject, kind, about, begin, end)


def _after(episode: EpisodeRow, after: int) -> int | None:
    return None if episode.end_time is None else episode.end_time + after
