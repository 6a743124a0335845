"""report.html: one self-contained page that shows what a replay found and why.

The page contains its data as compressed JSON, and BokehJS, which draws it. Times in the data are whole multiples of a
unit after the beginning, each as the difference to the previous one.
Its actions are those that would have run: the applications demanded over time, and the data passed on.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from detector.results.episodes import EpisodeRow
from detector.results.result import Result, polygons_of
from detector.results.series import UNKNOWN, Integers, Series, SeriesKind, SubjectTrace, thinned
from wayside.manifests import to_yaml
from wayside.times import format_time, parse_time


class ActionRow(NamedTuple):
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


def action_rows(result: Result) -> list[ActionRow]:
    """The actions that would have run, in time order."""
    found = [*_tasks(result), *_windows(result)]
    return sorted(found, key=lambda row: (row.begin, row.rule, row.subject, row.action))


def _tasks(result: Result) -> Iterator[ActionRow]:
    for task in result.tasks:
        event, spec = task.spec.event, task.spec
        if event is None:
            continue
        parameters = ", ".join(f"{name}={json.dumps(value)}" for name, value in spec.parameters.items())
        about = f"{spec.template_name}: {parameters}" if parameters else spec.template_name
        end = None if spec.end_time is None else parse_time(spec.end_time)
        begin = parse_time(event.start_time)
        yield ActionRow(event.rule, event.action, event.subject, str(spec.operation).lower(), about, begin, end)


def _windows(result: Result) -> Iterator[ActionRow]:
    for episode in result.episodes:
        rule = result.rules.get(episode.rule)
        if rule is None or rule.dry_run:
            continue
        for action in rule.actions:
            kind = next((key for key in json.loads(action.source) if key != "name"), "action")
            if action.window is None:
                yield ActionRow(rule.name, action.name, episode.subject, kind, "", episode.start_time, episode.end_time)
                continue
            window = action.window
            begin = episode.onset_time - window.before_ns
            end = None if episode.end_time is None else episode.end_time + window.after_ns
            about = ", ".join(sorted(window.streams))
            yield ActionRow(rule.name, action.name, episode.subject, kind, about, begin, end)


MOST = 140_000
"""Approximate maximum number of points of series in a page."""
_WIDEST = 1500
"""Maximum number of periods in a series: more than a plot has pixels."""
_PLACES = 600
"""Maximum number of places of a client on the map."""
_VALUES = 2000
"""Maximum number of episodes with values in a page; the others have only times."""
_ACTIONS = 2000
"""Maximum number of listed actions that would have run; the page gives the total number."""


def write_report(path: Path, result: Result) -> None:
    """Write the page."""
    path.write_text(_page(data_of(result)), encoding="utf-8")


def _page(data: Mapping[str, Any]) -> str:
    """The page around the data; the same data gives the same bytes."""
    own = resources.files("detector.results") / "page"
    scripts = resources.files("bokeh") / "server" / "static" / "js"
    packed = gzip.compress(json.dumps(data, separators=(",", ":"), allow_nan=False).encode(), 9, mtime=0)
    body = (own / "report.html").read_text("utf-8")
    bokeh = "\n".join((scripts / name).read_text("utf-8") for name in ("bokeh.min.js", "bokeh-api.min.js"))
    script = (own / "report.js").read_text("utf-8")
    return html_page(
        f"Replay of {data['recording']}",
        f'{body}\n<script type="text/plain" id="data">{base64.b64encode(packed).decode()}</script>\n'
        f"<script>{bokeh}</script>\n<script>{script}</script>",
        style=(own / "report.css").read_text("utf-8"),
        policy="script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; font-src data:",
    )


def html_page(title: str, body: str, *, style: str, policy: str) -> str:
    """A page that loads nothing; `policy` is the part of its Content-Security-Policy after `default-src 'none'`."""
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; {policy}">
<title>{escape(title)}</title>
<style>{style}</style>
</head>
<body>
{body}
</body>
</html>
"""


def data_of(result: Result) -> dict[str, Any]:
    """The data of the page."""
    trace = result.trace
    episodes = result.episodes
    table = _Table(result)
    by_subject: dict[tuple[str, str], list[EpisodeRow]] = {}
    detailed = {episode.episode for episode in episodes[:_VALUES]}
    for episode in episodes:
        by_subject.setdefault((episode.rule, episode.subject), []).append(episode)
    subjects = [
        _subject(result, each, by_subject.get((each.rule, each.subject), ()), table, detailed)
        for each in trace.subjects
    ]
    actions = action_rows(result)
    return {
        "recording": Path(result.recording).name,
        "begin": format_time(trace.begin),
        "beginNs": str(trace.begin),
        "length": (trace.end - trace.begin) / 1e9,
        "unit": table.unit,
        "samples": result.samples,
        "rules": [_rule(result, name, episodes) for name in sorted(result.rules)],
        "subjects": subjects,
        "series": table.entries,
        "paths": _paths(result, table),
        "geographic": trace.geographic,
        "polygons": [
            {"rule": each.rule, "name": each.name, "corners": each.corners, "closed": each.closed}
            for each in polygons_of(result.rules.values())
            if each.geographic == trace.geographic
        ],
        "actions": [
            [each.rule, each.action, each.subject, each.what, each.about, table.seconds(each.begin),
             None if each.end is None else table.seconds(each.end)]
            for each in actions[:_ACTIONS]
        ],
        "actionCount": len(actions),
        "demands": _demands(actions, table),
        "nearest": [[each.rule, each.subject, table.seconds(each.time), each.margin] for each in result.nearest],
        "streams": [
            {
                "stream": each.stream, "key": each.key, "encoding": each.encoding, "samples": each.samples,
                "keys": each.keys, "rate": each.rate, "gap": each.gap, "gapKey": each.gap_key,
                "gapAt": None if each.gap_time is None else table.seconds(each.gap_time),
                "unreadable": each.unreadable, "lastUnreadable": each.last_unreadable, "unnamed": each.unnamed,
            }
            for each in result.streams
        ],
        "notes": [*result.notes],
    }  # fmt: skip


class _Table:
    """The series of a page; equal ones are stored once."""

    def __init__(self, result: Result) -> None:
        trace = result.trace
        self._begin, self._end = trace.begin, trace.end
        self.entries: list[dict[str, Any]] = []
        self._places: dict[bytes, int] = {}
        lengths: dict[bytes, int] = {}
        exact: dict[bytes, list[Integers]] = {}
        for subject in trace.subjects:
            changes = subject.changes
            for series in _series_of(result, subject).values():
                digest = _digest(series)
                lengths[digest] = len(series.times)
                exact.setdefault(digest, []).append(changes)
        self._exact = {digest: np.unique(np.concatenate(times)) for digest, times in exact.items()}
        """By series, the times at which a condition of any rule with this series changes."""
        self._buckets = _buckets([*lengths.values()])
        named = [series.times for each in trace.subjects for series in each.signals.values()]
        steps = [steps.times for each in trace.subjects for steps in each.conditions.values()]
        self.unit = _unit([*named, *steps, *_event_times(result)], trace.begin)

    def add(self, series: Series) -> int:
        """Add a series; returns its index."""
        digest = _digest(series)
        place = self._places.get(digest)
        if place is None:
            place = self._places[digest] = len(self.entries)
            short = thinned(series, self._begin, self._end, self._buckets, self._exact[digest])
            used = [*short.texts] if short.kind is SeriesKind.TEXT else None
            values = [value if math.isfinite(value) else None for value in short.values.tolist()]
            if short.kind is not SeriesKind.NUMBER:
                values = [None if value is None else int(value) for value in values]
            entry: dict[str, Any] = {"kind": short.kind.value, "t": self.times(short.times), "v": values}
            self.entries.append({**entry, "texts": used} if used is not None else entry)
        return place

    def times(self, times: Integers) -> list[int]:
        """Differences in units; the first is the distance from the beginning."""
        differences = np.diff(times, prepend=self._begin) // self.unit
        found: list[int] = differences.tolist()
        return found

    def seconds(self, time: int) -> float:
        """Since the beginning."""
        return (time - self._begin) / 1e9


def _digest(series: Series) -> bytes:
    return hashlib.blake2b(series.times.tobytes() + series.values.tobytes(), digest_size=16).digest()


def _buckets(lengths: Sequence[int]) -> int:
    """The number of periods, so that all series together have about MOST points."""
    low, high = 20, _WIDEST
    while low < high:
        middle = (low + high + 1) // 2
        if sum(min(length, 2 * middle) for length in lengths) <= MOST:
            low = middle
        else:
            high = middle - 1
    return low


def _unit(times: Iterable[Integers], begin: int) -> int:
    """The greatest unit, in nanoseconds, such that all times are whole multiples of it after the beginning."""
    found = 0
    for each in times:
        if len(each):
            found = math.gcd(found, int(np.gcd.reduce(each - begin)))
    return found or 1


def _event_times(result: Result) -> list[Integers]:
    return [np.array([event.episode.start_time, event.episode.onset_time], np.int64) for event in result.events]


def _subject(
    result: Result, subject: SubjectTrace, episodes: Sequence[EpisodeRow], table: _Table, detailed: Set[str]
) -> dict[str, Any]:
    terms = result.terms.get((subject.rule, subject.subject))
    return {
        "rule": subject.rule,
        "subject": subject.subject,
        "clients": subject.clients,
        "episodes": [
            {
                "start": table.seconds(each.start_time),
                "end": None if each.end_time is None else table.seconds(each.end_time),
                "reason": each.reason,
                "values": _values(each) if each.episode in detailed else {},
            }
            for each in episodes
        ],
        "signals": {name: table.add(series) for name, series in _series_of(result, subject).items()},
        "conditions": {
            field: {
                "t": table.times(steps.times),
                "c": steps.codes.tolist(),
                "why": {str(at): why for at, why in steps.reasons.items()},
            }
            for field, steps in subject.conditions.items()
        },
        "thresholds": [list(each) for each in terms.thresholds] if terms is not None else [],
        "unknown": any((steps.codes == UNKNOWN).any() for steps in subject.conditions.values()),
    }


def _values(episode: EpisodeRow) -> dict[str, Any]:
    """The values that the page lists."""
    shown = (".start", ".max")
    values = ((name, value) for name, value in episode.values.items() if name.endswith(shown) and value is not None)
    return {name: value for name, value in values if not isinstance(value, float) or math.isfinite(value)}


def _series_of(result: Result, subject: SubjectTrace) -> dict[str, Series]:
    """First the signals that a condition compares, then the others."""
    terms = result.terms.get((subject.rule, subject.subject))
    return {**(terms.computed if terms is not None else {}), **subject.signals}


def _rule(result: Result, name: str, episodes: Sequence[EpisodeRow]) -> dict[str, Any]:
    document, rule = result.documents.get(name), result.rules[name]
    own = [each for each in episodes if each.rule == name]
    evaluations, unknowns, errors = result.counts.get(name, (0, 0, 0))
    text = f"when: {rule.when.source}\n"
    if document is not None:
        whole = document.model_dump(mode="json", by_alias=True)
        brief = document.model_dump(mode="json", by_alias=True, exclude_defaults=True)
        text = to_yaml([{name: whole[name] for name in ("apiVersion", "kind")} | brief])
    return {
        "name": name,
        "description": "" if document is None else document.spec.description,
        "text": text,
        "when": rule.when.source,
        "until": None if rule.until is None else rule.until.source,
        "for": rule.for_ns / 1e9,
        "episodes": len(own),
        "subjects": len({each.subject for each in own}),
        "evaluations": evaluations,
        "unknowns": unknowns,
        "errors": errors,
    }


def _paths(result: Result, table: _Table) -> list[dict[str, Any]]:
    found = []
    for client, path in sorted(result.trace.paths.items()):
        stride = max(1, -(-len(path.times) // _PLACES))
        axes = path.axes[:, ::stride]
        x, y = (axes[1], axes[0]) if result.trace.geographic else (axes[0], axes[1])
        found.append(
            {
                "client": client,
                "t": [table.seconds(time) for time in path.times[::stride].tolist()],
                "x": np.round(x, 7 if result.trace.geographic else 2).tolist(),
                "y": np.round(y, 7 if result.trace.geographic else 2).tolist(),
            }
        )
    return found


def _demands(actions: Sequence[ActionRow], table: _Table) -> list[dict[str, Any]]:
    """By template, the number of tasks that demand it over time."""
    edges: dict[str, list[tuple[float, int]]] = {}
    for row in actions:
        if row.what != "deploy":
            continue
        own = edges.setdefault(row.about.partition(":")[0], [])
        own.append((table.seconds(row.begin), 1))
        if row.end is not None:
            own.append((table.seconds(row.end), -1))
    found = []
    for template, changes in sorted(edges.items()):
        times, counts, count = [0.0], [0], 0
        for time, change in sorted(changes):
            count += change
            if times[-1] == time:
                counts[-1] = count
            else:
                times.append(time)
                counts.append(count)
        found.append({"template": template, "t": times, "n": counts})
    return found
