"""The documents about a scenario: its description, its type, and its clients.

A scenario is complete only if `complete` is true. This is written last, after all its samples.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from bson import Int64
from bson.datetime_ms import DatetimeMS

from detector.actions.database.documents import bson_values
from detector.actions.database.queue import Write
from detector.actions.episode import Completion, Episode
from wayside.api import Detector, EventRule
from wayside.api.base import JsonValue

SCENARIOS, TYPES, CLIENTS = "Scenarios", "ScenarioTypes", "ConnectedClients"
OPEN, COMPLETE, INCOMPLETE, INTERRUPTED = "Open", "Complete", "Incomplete", "Interrupted"


def scenario_id(episode: Episode, action: str, part: str = "") -> str:
    """The same id for the same episode, action and part, whichever process writes it."""
    return f"{episode.id}.{action}{part and f'.{part}'}"


@dataclass(slots=True)
class Scenario:
    """The state of a scenario while it is written."""

    id: str
    holder: str
    action: str
    database: str
    rule: EventRule
    resumed: bool
    messages: Counter[str] = field(default_factory=Counter)
    """Documents handed over, by collection."""
    clients: dict[str, tuple[int, int, set[str]]] = field(default_factory=dict)
    """By client, the first and last time, and its streams."""
    bytes: int = 0
    files: int = 0
    lost: Counter[str] = field(default_factory=Counter)
    """Missing parts, by reason."""

    def note_sample(self, client: str, stream: str, time: int) -> None:
        """Note a sample of a client."""
        first, last, streams = self.clients.get(client, (time, time, set()))
        streams.add(stream)
        self.clients[client] = (min(first, time), max(last, time), streams)


def type_id(rule: EventRule) -> str:
    """The id of a rule's version: its scenarios have this type. A rule from a file has no generation and is identified
    by its text.
    """
    version = str(rule.metadata.generation)
    if not rule.metadata.generation:
        version = hashlib.sha256(_text(rule).encode()).hexdigest()[:12]
    return f"{rule.metadata.namespace}/{rule.name}@{version}"


def _text(rule: EventRule) -> str:
    return json.dumps(rule.spec.to_json(), ensure_ascii=False, sort_keys=True)


def start_scenario(scenario: Scenario, episode: Episode, metadata: Mapping[str, JsonValue]) -> list[Write]:
    """Insert it, marked as incomplete."""
    rule = scenario.rule
    of_type = {
        "rule": rule.name,
        "namespace": rule.metadata.namespace,
        "generation": Int64(rule.metadata.generation),
        "description": rule.spec.description,
        "classification": None if rule.spec.classification is None else rule.spec.classification.to_json(),
        "spec": _text(rule),  # as text: its names may be invalid in MongoDB
    }
    known = {
        "rule": rule.name,
        "generation": Int64(rule.metadata.generation),
        "type": type_id(rule),
        "classification": episode.classification,
        "episode": episode.id,
        "holder": scenario.holder,
        "action": scenario.action,
        "subject": episode.subject,
        "subjects": list(episode.clients),
        "element": episode.element,
        "onset": DatetimeMS(episode.onset_time // 1_000_000),
        "onsetTime": Int64(episode.onset_time),
        "startTime": Int64(episode.start_time),
        **bson_values({"values": episode.values, "metadata": metadata}),
        "complete": False,
        "rejected": False,
    }
    writes = [
        _change(scenario, TYPES, {"_id": type_id(rule)}, {"$setOnInsert": of_type}),
        _change(scenario, SCENARIOS, {"_id": scenario.id}, {"$setOnInsert": {**known, "state": OPEN}}),
    ]
    if scenario.resumed:
        interrupted = {"state": INTERRUPTED, "interrupted": True}
        writes.append(_change(scenario, SCENARIOS, {"_id": scenario.id}, {"$set": interrupted}))
    return writes


def mark_interrupted(database: str, holder: str, rule: str, action: str) -> Write:
    """Mark the scenarios that an earlier run left open as interrupted: no process writes them any more."""
    find = {"holder": holder, "rule": rule, "action": action, "state": OPEN}
    change = {"find": find, "change": {"$set": {"state": INTERRUPTED, "interrupted": True}}, "many": True}
    return Write(database, SCENARIOS, changes=[change])


def finish(
    scenario: Scenario, episode: Episode, completion: Completion, detector: Detector, incomplete: str
) -> list[Write]:
    """Write the final documents. The last request marks it as complete, unless it is `incomplete`."""
    labels = {client.name: client.labels for client in detector.spec.clients}
    clients = [
        {
            "find": {"_id": name},
            "change": {
                "$setOnInsert": {"name": name},
                "$set": {"labels": labels.get(name, {})},
                "$min": {"firstSeen": Int64(first)},
                "$max": {"lastSeen": Int64(last)},
                "$addToSet": {"streams": {"$each": sorted(streams)}, "detectors": scenario.holder},
            },
            "many": False,
        }
        for name, (first, last, streams) in sorted(scenario.clients.items())
    ]
    known: dict[str, Any] = {
        "endTime": None if episode.end_time is None else Int64(episode.end_time),
        "reason": episode.reason,
        **({} if episode.ended is None else bson_values({"endValues": episode.ended["data"]["values"]})),
        "clients": sorted(scenario.clients),
        "since": Int64(min((first for first, _, _ in scenario.clients.values()), default=0)),
        "until": Int64(max((last for _, last, _ in scenario.clients.values()), default=0)),
        "messages": {name: Int64(count) for name, count in sorted(scenario.messages.items())},
        "bytes": Int64(scenario.bytes),
        "files": Int64(scenario.files),
        "cut": completion.cut,
        "missing": Int64(missing(scenario, completion)),
        "lost": {reason: Int64(count) for reason, count in sorted(scenario.lost.items())},
    }
    find = {"_id": scenario.id}
    writes = [Write(scenario.database, CLIENTS, changes=clients)] if clients else []
    if incomplete:
        state = INTERRUPTED if scenario.resumed else INCOMPLETE
        return [*writes, _change(scenario, SCENARIOS, find, {"$set": {**known, "state": state}}, scenario.id)]
    intact = {**find, "rejected": False, "state": {"$in": [OPEN, COMPLETE]}}
    last = {"find": intact, "change": {"$set": {"state": COMPLETE, "complete": True}}, "many": True}
    return [
        *writes,
        _change(scenario, SCENARIOS, find, {"$set": known}),
        Write(scenario.database, SCENARIOS, changes=[last], completes=scenario.id, expected=dict(scenario.messages)),
    ]


def why_incomplete(scenario: Scenario, episode: Episode | None, completion: Completion) -> str:
    """Why it is incomplete; empty if it is complete. Without the episode, another scenario follows."""
    reasons = [f"{count} lost: {reason}" for reason, count in sorted(scenario.lost.items())]
    if completion.missing:
        reasons.append(f"{completion.missing} lost: the samples arrived faster than the action could process them")
    if completion.cut:
        reasons.append(completion.cut)
    if scenario.resumed:
        reasons.append("the episode started in an earlier run of the detector")
    if episode is not None and episode.end_time is None and not completion.cut:
        reasons.append("the episode did not end in this run")
    return "; ".join(reasons)


def missing(scenario: Scenario, completion: Completion) -> int:
    """How many samples, or parts of them, are missing."""
    return completion.missing + sum(scenario.lost.values())


def reject(database: str, scenario: str, why: str) -> Write:
    """The server refused one of its documents: it can no longer become complete."""
    change = {"$set": {"rejected": True, "rejection": why, "state": INCOMPLETE, "complete": False}}
    return Write(database, SCENARIOS, changes=[{"find": {"_id": scenario}, "change": change, "many": False}])


def give_up(write: Write, why: str) -> Write:
    """Replaces the request that would have marked a scenario as complete."""
    change = {"find": {"_id": write.completes}, "change": {"$set": {"state": INCOMPLETE, "cut": why}}, "many": False}
    return Write(write.database, SCENARIOS, changes=[change])


def _change(
    scenario: Scenario, collection: str, find: Mapping[str, Any], change: Mapping[str, Any], completes: str = ""
) -> Write:
    changes = [{"find": find, "change": change, "many": False}]
    return Write(scenario.database, collection, changes=changes, completes=completes)
