"""The known ITS messages: their numbers, their definitions, and the fields of their times."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

from detector.streams.codecs.etsi import quantities
from detector.streams.codecs.etsi.asn1 import DefinitionError, Type
from detector.streams.codecs.etsi.own import OwnDefinitions
from detector.streams.codecs.etsi.packaged import packaged_type
from detector.streams.codecs.etsi.reading import Read, Readers

Stamp = Callable[[Mapping[str, Any], int], int | None]
"""From a message and its receive time to the sender's time; nanoseconds since the epoch. None if it has none."""

PREFIX = "etsi/"
"""The prefix of a stream's type: etsi/cam."""


def _milliseconds(seconds: float) -> int:
    return round(seconds * 1000) * 10**6


def _generation(part: str) -> Stamp:
    return lambda message, received: quantities.nearest_time(
        round(message[part]["generationDeltaTime"] * 1000), received
    )


def _denm(message: Mapping[str, Any], received: int) -> int | None:
    return _milliseconds(message["denm"]["management"]["referenceTime"])


def _cpm(message: Mapping[str, Any], received: int) -> int | None:
    reference = message.get("payload", {}).get("managementContainer", {}).get("referenceTime")
    return None if reference is None else _milliseconds(reference)


def _spatem(message: Mapping[str, Any], received: int) -> int | None:
    first = message["spat"]["intersections"][0]
    minute, rest = first.get("moy"), first.get("timeStamp")
    if minute is None or rest is None:
        return None
    return quantities.in_year(round(minute / 60), round(rest * 1000), received)


def _none(message: Mapping[str, Any], received: int) -> int | None:
    return None


@dataclass(frozen=True, slots=True, eq=False)
class MessageKind:
    """One kind of message."""

    name: str
    number: int
    """messageId in the header (TS 102 894-2)."""
    types: tuple[str, ...]
    """The names of its type in the ASN.1 modules, in all versions."""
    packaged: Mapping[int, tuple[str, str]]
    """The package and module of pycrate that define it, by protocol version."""
    stamp: Stamp


_RELEASE_1 = "ITS_r1318"
_INFRASTRUCTURE = "ITS_IS"

KINDS = tuple(
    MessageKind(name, number, types, {version: (package, module) for version, package in packages.items()}, stamp)
    for name, number, types, module, packages, stamp in (
        ("denm", 1, ("DENM",), "DENM_PDU_Descriptions", {1: _RELEASE_1, 2: "ITS_DENM_3"}, _denm),
        ("cam", 2, ("CAM",), "CAM_PDU_Descriptions", {1: _RELEASE_1, 2: "ITS_CAM_2"}, _generation("cam")),
        ("spatem", 4, ("SPATEM",), "SPATEM_PDU_Descriptions", {1: _RELEASE_1, 2: _INFRASTRUCTURE}, _spatem),
        ("mapem", 5, ("MAPEM",), "MAPEM_PDU_Descriptions", {1: _RELEASE_1, 2: _INFRASTRUCTURE}, _none),
        ("cpm", 14, ("CollectivePerceptionMessage", "CPM"), "", {}, _cpm),
        ("vam", 16, ("VAM",), "VAM_PDU_Descriptions", {1: "ITS_VAM_3", 2: "ITS_VAM_3"}, _generation("vam")),
    )
)

BY_NAME = {kind.name: kind for kind in KINDS}
BY_NUMBER = {kind.number: kind for kind in KINDS}


@cache
def packaged_definitions(kind: MessageKind) -> Mapping[int, Type]:
    """The kind's type by protocol version, from the installed extra.

    Raises DefinitionError if the extra is not installed.
    """
    made: dict[tuple[str, str], Type] = {}
    for package, module in kind.packaged.values():
        if (package, module) not in made:
            made[package, module] = packaged_type(package, module, kind.types[0])
    return {version: made[place] for version, place in kind.packaged.items()}


def definitions(kind: MessageKind, own: OwnDefinitions | None) -> Mapping[int, Type]:
    """The kind's type by protocol version: from the user's definitions if they have it.

    Messages of the first version, which are read differently, use the definitions of the extra. Raises DefinitionError
    if there are none at all.
    """
    found = None if own is None else own.type(kind.types)
    if found is None:
        if not kind.packaged:
            raise DefinitionError(
                f"no package provides the ASN.1 definition of {PREFIX}{kind.name}: name the files with it in spec.asn1"
            )
        return packaged_definitions(kind)
    return {**dict.fromkeys(range(1, 256), found), **({1: packaged_definitions(kind)[1]} if 1 in kind.packaged else {})}


@lru_cache(maxsize=64)
def reader(definition: Type) -> Read:
    """The function that reads messages of the type."""
    return Readers().reader(definition)


__all__ = [
    "BY_NAME",
    "BY_NUMBER",
    "KINDS",
    "PREFIX",
    "DefinitionError",
    "MessageKind",
    "Stamp",
    "definitions",
    "reader",
]
