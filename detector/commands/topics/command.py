"""The implementation of `detector topics`: recordings or a network in, a list of their contents out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import typer

from detector.commands.topics.listening import listen
from detector.commands.topics.listing import lines, yaml_of
from detector.commands.topics.proposal import proposals
from detector.commands.topics.survey import Survey, survey
from detector.replay.errors import RecordingError
from detector.replay.gathering import Recording, intake_file_of, recordings_of
from wayside.api.zenoh import Zenoh, ZenohMode
from wayside.inputerror import InputError
from wayside.process.commandline import refuse


class NothingHeardError(InputError, ValueError):
    """No samples were received over the network."""


def list_topics(recordings: Sequence[Path], *, as_yaml: bool) -> None:
    """Print the contents of the recordings, or a Detector for them.

    Raises:
        RecordingError: a recording is missing, damaged or empty.
    """
    if intake_file_of(recordings) is not None:
        refuse("an intake file contains its Detector, so its streams are known: give another recording")
    gathered = recordings_of(recordings)
    found = survey(gathered)
    for cut in found.cuts:
        typer.echo(f"warning: {cut}", err=True)
    if not found.topics:
        raise RecordingError(f"{recordings[0]} contains no message")
    _show(found, gathered, None, as_yaml=as_yaml)


def list_live_topics(connect: Sequence[str], seconds: float, *, as_yaml: bool) -> None:
    """Print the topics that receive samples over Zenoh within some seconds, or a Detector for them.

    Args:
        connect: endpoints; none: those that scouting finds on the local network.
        seconds: how long to listen.
        as_yaml: print a Detector.

    Raises:
        NetworkError: no endpoint can be reached.
        NothingHeardError: nothing came.
    """
    config = Zenoh(mode=ZenohMode.CLIENT, connect=[*connect], scouting=False) if connect else Zenoh()
    found = listen(config, seconds)
    if not found.topics:
        where = ", ".join(connect) or "the local network"
        raise NothingHeardError(
            f"received nothing from {where} within {seconds:g} s: correct --connect, or raise --seconds"
        )
    network = config.model_dump(mode="json", by_alias=True, include={"mode", "connect"}) if connect else None
    _show(found, (), network, as_yaml=as_yaml)


def _show(found: Survey, gathered: Sequence[Recording], network: Mapping[str, Any] | None, *, as_yaml: bool) -> None:
    streams = proposals(found.topics)
    if as_yaml:
        typer.echo(yaml_of(streams, gathered, network), nl=False)
        return
    for line in lines(streams, gathered):
        typer.echo(line)
