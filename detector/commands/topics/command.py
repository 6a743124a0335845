"""The implementation of `detector topics`: recordings or a network in, a list of their contents out."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import typer
import zenoh

from detector.assembly import DetectorError, stream_readers
from detector.commands.topics.proposal import Proposal, detector_document, proposals
from detector.commands.topics.survey import SurveyResult, Topic, message_paths, survey, topic_shape
from detector.replay.gathering import Recording, intake_file_of, recordings_of
from detector.replay.message import RecordingError
from detector.replay.recorded_types import with_recorded_types
from detector.streams.rmw_zenoh import KeyMismatchError, split
from detector.streams.session import open_session
from wayside.api import Detector
from wayside.api.stream import Encoding, Layout
from wayside.api.zenoh import Zenoh, ZenohMode
from wayside.inputerror import InputError
from wayside.manifests import to_yaml
from wayside.process.commandline import refuse
from wayside.rules import Fields
from wayside.times import format_time


class NoSamplesError(InputError, ValueError):
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
        connect: endpoints; none: discover them in the local network.
        seconds: how long to listen.
        as_yaml: print a Detector.

    Raises:
        NetworkError: no endpoint can be reached.
        NoSamplesError: no samples were received.
    """
    config = Zenoh(mode=ZenohMode.CLIENT, connect=[*connect], scouting=False) if connect else Zenoh()
    found = listen(config, seconds)
    if not found.topics:
        where = ", ".join(connect) or "the local network"
        raise NoSamplesError(
            f"received nothing from {where} within {seconds:g} s: correct --connect, or raise --seconds"
        )
    network = config.model_dump(mode="json", by_alias=True, include={"mode", "connect"}) if connect else None
    _show(found, (), network, as_yaml=as_yaml)


def _show(
    found: SurveyResult, gathered: Sequence[Recording], network: Mapping[str, Any] | None, *, as_yaml: bool
) -> None:
    streams = proposals(found.topics)
    if as_yaml:
        typer.echo(yaml_of(streams, gathered, network), nl=False)
        return
    for line in lines(streams, gathered):
        typer.echo(line)


_OURS = "wayside/"
"""Keys of detectors: events, progress events and responses."""
_ENCODINGS = {"application/json": Encoding.JSON, "application/cbor": Encoding.CBOR, "application/cdr": Encoding.CDR}


def listen(config: Zenoh, seconds: float) -> SurveyResult:
    """The samples on all keys within `seconds`. Raises NetworkError if there is no session."""
    received: queue.SimpleQueue[tuple[int, zenoh.Sample]] = queue.SimpleQueue()
    topics: dict[str, Topic] = {}
    with open_session(config) as session:
        session.declare_subscriber("**", lambda sample: received.put((time.time_ns(), sample)))
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                at, sample = received.get(timeout=left)
            except queue.Empty:
                break
            key = str(sample.key_expr)
            if sample.kind != zenoh.SampleKind.PUT or key.startswith(_OURS):
                continue
            topic = topics.get(key)
            if topic is None:
                topic = topics[key] = _topic(key, str(sample.encoding).partition(";")[0])
            topic.add(at, sample.payload.to_bytes())
    return SurveyResult(sorted(topics.values(), key=lambda topic: topic.key), [])


def _topic(key: str, encoding: str) -> Topic:
    try:
        name, kind = split(key)
    except KeyMismatchError:
        recorded_as = _ENCODINGS.get(encoding)
        return Topic(key, "" if recorded_as is None else recorded_as.value, None, None)
    return Topic(name, Encoding.CDR.value, kind, None, layout=Layout.RMW_ZENOH)


def lines(found: Sequence[Proposal], recordings: Sequence[Recording]) -> Iterator[str]:
    """The text for users. Raises RecordingError if a recording's definitions cannot be read."""
    types = _types(found, recordings)
    for each in found:
        yield each.key
        kind = each.type or (each.topics[0].recorded_as if each.encoding is Encoding.RAW else "")
        rate = each.rate
        worst = each.worst
        facts = [
            each.encoding.value + (f" ({kind})" if kind and kind != each.encoding.value else ""),
            "" if each.client is not None else _counted(len(each.clients), "client") + f": {_some(each.clients)}",
            _counted(each.count, "message"),
            "" if rate is None else f"{rate:.3g} Hz",
            "" if not worst.gap else f"longest gap {worst.gap / 1e9:.3g} s of {worst.key} at {_clock(worst.gap_time)}",
        ]
        yield "  " + ", ".join(fact for fact in facts if fact)
        fields = [*_fields(each, types)]
        width = min(max((len(path) for path, _ in fields), default=0), 50)
        for path, what in fields:
            yield f"    {path:{width}}  {what}".rstrip()


def _fields(each: Proposal, types: dict[str, Fields]) -> Iterator[tuple[str, str]]:
    found: dict[str, str] = {}
    for topic in each.topics:
        shape = topic_shape(topic, each.encoding)
        found.update(shape.paths() if shape is not None else ())
    if found:
        yield from found.items()
    elif types.get(each.name):
        yield from message_paths(types[each.name])
    elif each.encoding is Encoding.RAW:
        yield "msg", "bytes, for numberAt, utf8 and checksum"


def yaml_of(found: Sequence[Proposal], recordings: Sequence[Recording], zenoh: Mapping[str, Any] | None = None) -> str:
    """A Detector with the streams, and the definitions of types that only the recordings have."""
    completed = _completed(found, recordings)
    messages = [message.model_dump(mode="json", by_alias=True) for message in completed.spec.messages]
    return to_yaml([detector_document(found, messages, zenoh)])


def _completed(found: Sequence[Proposal], recordings: Sequence[Recording]) -> Detector:
    detector = Detector.model_validate(detector_document(found))
    files: list[Path] = [path for recording in recordings for path in recording]
    return with_recorded_types(detector, files)


def _types(found: Sequence[Proposal], recordings: Sequence[Recording]) -> dict[str, Fields]:
    """The fields of streams whose messages have a known type."""
    try:
        return {**stream_readers(_completed(found, recordings)).fields}
    except DetectorError:
        return {}  # a type without any definition


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (" …" if len(names) > 5 else "")


def _counted(count: int, noun: str) -> str:
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


def _clock(time: int) -> str:
    return format_time(time)[11:23]
