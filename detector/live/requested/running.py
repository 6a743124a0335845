"""Runs a recording on request: by the record action of a generated rule, with a separate episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from detector.actions.outcomes import Which
from detector.engine.consequences.consequences import Consequences, Run
from detector.engine.episodes.events import Event
from detector.engine.episodes.identifiers import identifier
from detector.engine.episodes.record import EpisodeRecord
from detector.live.requested.index import RequestedRecording
from wayside.api import API_VERSION, Detector, EventRule
from wayside.names import FLEET, parse_subject
from wayside.rules.actions import window_of

REQUESTED = Which("_requested", "record")
"""The rule and the action under which they run: no EventRule in a cluster can have that name."""


def with_requested(rules: Sequence[EventRule], detector: Detector) -> list[EventRule]:
    """The rules whose actions run, including the rule for recordings on request if the Detector allows these."""
    recordings = detector.spec.recordings
    if recordings is None or recordings.on_request is None:
        return list(rules)
    rule = EventRule.model_validate(
        {
            "apiVersion": API_VERSION,
            "kind": "EventRule",
            "metadata": {"name": REQUESTED.rule, "namespace": detector.namespace},
            "spec": {
                "description": "Recordings requested by others.",
                "when": "false",
                "actions": [{"name": REQUESTED.action, "record": {}}],
            },
        }
    )
    return [*rules, rule]


def run_of(identity: str) -> Run:
    """The run of a recording; its episode is a short name derived from the id, which may be long."""
    return Run(REQUESTED.rule, REQUESTED.action, identifier(identity.encode()))


def begin_recording(
    consequences: Consequences,
    entry: RequestedRecording,
    detector: Detector,
    holder: str,
    clients: Sequence[str] | None,
    cause: dict[str, Any],
    now: int,
) -> None:
    """Begin to pass on the samples of the recording. `cause` is the requester's event; nothing in it is trusted."""
    subject, subjects = _about(cause)
    data = cause.get("data")
    classification = data.get("classification") if isinstance(data, dict) else None
    run = run_of(entry.id)
    episode = EpisodeRecord(
        id=run.episode,
        rule=run.rule,
        subject=subject,
        clients=subjects,
        element=None,
        onset_time=now if entry.since is None else min(now, entry.since),
        start_time=now,
        values={"request": entry.id, "event": cause},
        classification=classification if isinstance(classification, dict) else None,
    )
    streams = [stream for stream in detector.spec.streams if stream.name in entry.streams]
    wanted = None if clients is None else frozenset(clients)
    window = window_of(detector.spec, streams, wanted)
    event = Event(holder, episode, episode.values)
    consequences.request(run, event, window, wanted, episode.onset_time, entry.until or now)


def _about(cause: dict[str, Any]) -> tuple[str, tuple[str, ...]]:
    """The subject of the requester's event; it is part of file names."""
    subject = cause.get("subject")
    if isinstance(subject, str) and len(subject) <= 256:
        try:
            return subject, parse_subject(subject)[0]
        except ValueError:
            pass
    return FLEET, ()
