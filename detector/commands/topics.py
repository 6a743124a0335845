"""What `detector topics` runs: recordings in, a list of what they hold out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import typer

from detector.replay.errors import RecordingError
from detector.replay.gathering import intake_file_of, recordings_of
from detector.topics.listing import lines, yaml_of
from detector.topics.proposal import proposals
from detector.topics.survey import survey
from wayside.commandline import refuse


def list_topics(recordings: Sequence[Path], *, as_yaml: bool) -> None:
    """Print what the recordings hold, or a Detector that takes it.

    Raises:
        RecordingError: a recording is missing or damaged, or holds no message.
    """
    if intake_file_of(recordings) is not None:
        refuse("an intake file brings its Detector along: its streams are known; give another recording")
    gathered = recordings_of(recordings)
    found = survey(gathered)
    for cut in found.cuts:
        typer.echo(f"warning: {cut}", err=True)
    if not found.topics:
        raise RecordingError(f"{recordings[0]} holds no message")
    streams = proposals(found.topics)
    if as_yaml:
        typer.echo(yaml_of(streams, gathered), nl=False)
        return
    for line in lines(streams, gathered):
        typer.echo(line)
