"""A line in a logbook for each episode: when, who, a note, and how many messages of the window there were."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from pydantic import Field

from detector.actions import (
    Action,
    ActionContext,
    ActionError,
    ActionParameters,
    Completion,
    Episode,
    EpisodeSample,
    Outcome,
    OutcomeState,
)


class LogbookParameters(ActionParameters):
    """The path of the logbook."""

    path: str = Field(min_length=1)
    """A file, one line of JSON an episode; its folder must be there."""


class Logbook(Action[LogbookParameters]):
    """Counts the samples of an episode, and writes its line when there is nothing more to come."""

    Parameters = LogbookParameters

    def __init__(self, parameters: LogbookParameters, context: ActionContext) -> None:
        super().__init__(parameters, context)
        self.counts: dict[str, int] = {}

    def started(self, episode: Episode) -> None:
        """Begin to count."""
        self.counts[episode.id] = 0

    def samples(self, episode: Episode, samples: Sequence[EpisodeSample]) -> None:
        """Count on."""
        self.counts[episode.id] += len(samples)

    def completed(self, episode: Episode, completion: Completion) -> None:
        """Write the line, and report it."""
        count = self.counts.pop(episode.id)
        line = json.dumps(
            {
                "rule": episode.rule,
                "subject": episode.subject,
                "seconds": None if episode.end_time is None else (episode.end_time - episode.start_time) / 1e9,
                "note": episode.rendered.get("note"),
                "samples": count,
                "cut": completion.cut,
            }
        )
        try:
            with Path(self.parameters.path).open("a") as file:
                size = file.write(line + "\n")
        except OSError as error:
            raise ActionError(f"the logbook cannot be written: {error}") from error
        self.context.report(
            episode, Outcome(OutcomeState.DONE, samples=count, bytes=size, files=(self.parameters.path,))
        )
