"""Versions of intake files: a file replays with the defaults and the time order of its detector's version.

Version 1: a stream becomes stale after `clientTimeout`, and a position is known while its stream is not stale. Version
2: `staleAfter` is 5 s and `maxAge` of a position 1 s by default; for the order, see `engine.timing.timeline`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from wayside.rules import CompiledRule, PairSubject

_CLIENT_TIMEOUT = "30s"


def detector_as_of(document: dict[str, Any], version: int) -> dict[str, Any]:
    """A recorded Detector, with the defaults of its version written out."""
    if version > 1:
        return document
    spec = document["spec"]
    stale = spec.get("clientTimeout", _CLIENT_TIMEOUT)
    streams = [
        stream if stream.get("latched") or "staleAfter" in stream else {**stream, "staleAfter": stale}
        for stream in spec["streams"]
    ]
    return {**document, "spec": {**spec, "streams": streams}}


def rule_as_of(rule: CompiledRule, version: int) -> CompiledRule:
    """A recorded rule, evaluated as in its version."""
    if version > 1 or not isinstance(rule.subject, PairSubject):
        return rule
    position = replace(rule.subject.position, max_age_ns=None)
    return replace(rule, subject=replace(rule.subject, position=position))
