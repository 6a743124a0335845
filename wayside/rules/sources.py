"""Checks that the streams and sources of a Detector match. The parameters of a plugin are checked where it runs."""

from __future__ import annotations

import difflib
from collections.abc import Iterator

from wayside.api import Detector
from wayside.api.source import ZENOH
from wayside.keys import KeyPattern, KeyPatternError
from wayside.rules.problems import RuleProblem


def source_problems(detector: Detector) -> Iterator[RuleProblem]:
    """Sources that are named wrongly or not at all, sources without streams, and what only Zenoh can do."""
    names = [source.name for source in detector.spec.sources]
    for index, source in enumerate(detector.spec.sources):
        if source.name == ZENOH:
            yield RuleProblem(
                ("spec", "sources", index, "name"),
                f"{ZENOH} is the session of spec.zenoh, which always exists: choose another name",
            )
        elif not any(stream.source == source.name for stream in detector.spec.streams):
            yield RuleProblem(
                ("spec", "sources", index, "name"),
                f"no stream uses {source.name}: set source: {source.name} in a stream, or remove it",
            )
    for index, stream in enumerate(detector.spec.streams):
        if stream.source in (ZENOH, *names):
            if stream.source != ZENOH and (stream.history is not None or stream.recover):
                field = "recover" if stream.history is None else "history"
                yield RuleProblem(
                    ("spec", "streams", index, field),
                    f"is valid only for streams over Zenoh, not for source {stream.source}: remove it",
                )
            continue
        close = difflib.get_close_matches(stream.source, names, n=1)
        hint = f"did you mean {close[0]}?" if close else f"there are {', '.join([ZENOH, *names])}"
        yield RuleProblem(
            ("spec", "streams", index, "source"), f"Detector {detector.name} has no source {stream.source}; {hint}"
        )
    if detector.spec.zenoh.liveliness is not None:
        try:
            KeyPattern.parse(detector.spec.zenoh.liveliness)
        except KeyPatternError as error:
            yield RuleProblem(("spec", "zenoh", "liveliness"), str(error))
