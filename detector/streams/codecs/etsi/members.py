"""The fields of a message, so that a misspelt one is found before any message has arrived."""

from __future__ import annotations

from collections.abc import Iterable

from detector.streams.codecs.etsi import asn1
from detector.streams.codecs.etsi.reading import expression_name
from wayside.rules import Fields

_HEADER: Fields = dict.fromkeys(("protocolVersion", "messageId", "stationId"))


def message_members(definitions: Iterable[asn1.Type]) -> Fields:
    """The fields of a message that can have several versions."""
    members: dict[str, Fields | None] = {}
    for definition in definitions:
        members = {**_joined(members, _members(definition) or {})}
    return {**members, "header": _HEADER}


def _members(kind: asn1.Type) -> Fields | None:
    """The fields below a value of the type; None below numbers, texts, lists and unknown types."""
    match kind:
        case asn1.Sequence():
            parts = [*kind.root, *(kind.additions or ())]
            fields = [each for part in parts for each in (part.fields if isinstance(part, asn1.Group) else (part,))]
            return {expression_name(field.name): _members(field.type) for field in fields}
        case asn1.Choice():
            alternatives = [*kind.root, *(kind.additions or ())]
            return {expression_name(name): _members(inner) for name, inner in alternatives}
        case asn1.OctetString():
            return None if kind.containing is None else _members(kind.containing)
        case _:
            return None


def _joined(first: Fields, second: Fields) -> Fields:
    both = {**first, **second}
    for name in first.keys() & second.keys():
        one, other = first[name], second[name]
        both[name] = None if one is None or other is None else _joined(one, other)
    return both
