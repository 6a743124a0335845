"""Message types defined by recordings: a replay reads messages by the definitions that they were recorded with."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.typesys.store import Typestore

from detector.assembly import message_types
from detector.replay.message import RecordedType, RecordingError
from detector.replay.recordings import types_of
from detector.streams.codecs.definitions import Definition, DefinitionsError, from_idl, parsed
from detector.streams.codecs.ros import RosTypes, standard
from wayside.api import Detector
from wayside.api.stream import Encoding, MessageDefinition

_log = logging.getLogger(__name__)


def with_recorded_types(detector: Detector, recordings: Sequence[Path]) -> Detector:
    """The Detector, with its `messages` extended by the recordings' new or different definitions.

    Raises RecordingError if a recording is missing or damaged, if the only definition of a type cannot be read, and if
    two recordings define a type differently.
    """
    wanted = {stream.type for stream in detector.spec.streams if stream.encoding is Encoding.CDR}
    types, problems = message_types(detector.spec.messages)
    if problems:
        return detector  # it cannot run; the caller reports that
    new: dict[str, tuple[Path, Definition]] = {}
    for path in recordings:
        for recorded in types_of(path):
            if recorded.name in wanted and (definition := _definition(path, recorded, types)) is not None:
                _, before = new.setdefault(recorded.name, (path, definition))
                if parsed(before) != parsed(definition):
                    raise RecordingError(
                        f"{path}: {recorded.name} differs from its definition in {new[recorded.name][0]}: "
                        "replay the recordings one by one"
                    )
    if not new:
        return detector
    kept = [message for message in detector.spec.messages if message.name not in new]
    added = [
        MessageDefinition.model_construct(name=name, definition=definition.text)
        for name, (_, definition) in sorted(new.items())
    ]
    spec = detector.spec.model_copy(update={"messages": [*kept, *added]})
    return detector.model_copy(update={"spec": spec})


def _definition(path: Path, recorded: RecordedType, types: RosTypes) -> Definition | None:
    """The recording's definition of the type; None if it is not new."""
    if not recorded.text.strip():
        return None
    try:
        if recorded.idl:
            text = _as_msg(recorded.name, from_idl(recorded.text))
            definition = Definition(recorded.name, text)
        else:
            definition = Definition(recorded.name, recorded.text)
        inside = parsed(definition)
    except (DefinitionsError, ValueError) as error:
        if not types.known(recorded.name):
            raise RecordingError(
                f"{path}: cannot read the recorded definition of {recorded.name}: "
                f"define it in the Detector's spec.messages: {error}"
            ) from error
        _log.warning("%s: cannot read the recorded definition of %s; using the known one", path, recorded.name)
        return None
    same = all(types.known(name) and _like(types.fields(name), fields) for name, (_, fields) in inside.items())
    return None if same else definition


def _as_msg(name: str, inside: Typesdict) -> str:
    if name not in inside:
        raise ValueError(f"it defines {', '.join(inside) or 'nothing'}")
    store = Typestore()
    store.fielddefs.update({**standard().store.fielddefs, **inside})
    try:
        return store.generate_msgdef(name, ros_version=2)[0]
    except KeyError as error:
        raise ValueError(f"the definition of {error} is missing") from error


def _like(one: Sequence[tuple[str, FieldDesc]], other: Sequence[tuple[str, FieldDesc]]) -> bool:
    """Whether fields are the same; the placeholder field of an empty message is ignored."""
    return list(_meant(one)) == list(_meant(other))


def _meant(fields: Sequence[tuple[str, FieldDesc]]) -> Iterator[tuple[str, FieldDesc]]:
    return ((name, desc) for name, desc in fields if name != "structure_needs_at_least_one_member")
