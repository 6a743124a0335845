"""The scheme by which use cases of event detection are classified: 13 dimensions, 39 characteristic values.

The scheme is Table 1 of Reiher et al., "Event Detection in C-ITS: Classification, Use Cases, and Reference
Implementation", with our own wording of the definitions. It is the single source of the names of dimensions and values
for the kinds, the catalog, the checks and docs/classification.md. A rule's classification has one or more values per
dimension.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Self

from pydantic import Field, field_validator
from pydantic.alias_generators import to_snake

from wayside.api.base import SET_LIST, Model


class CharacteristicValue(StrEnum):
    """A characteristic value: its name in files, its name in prose, and its definition."""

    words: str
    definition: str

    def __new__(cls, words: str, definition: str) -> Self:
        """The member's text is its name in files: ShortTerm for short-term."""
        value = "".join(word[0].upper() + word[1:] for word in re.split("[ -]", words))
        member = str.__new__(cls, value)
        member._value_ = value
        member.words = words
        member.definition = definition
        return member

    def explained(self) -> str:
        """The value with its definition, as a diagnostic cites it."""
        return f"{self.value} ({self.definition})"


class OverarchingPurpose(CharacteristicValue):
    """The goal that the use case serves."""

    SAFETY = "safety", "to make road traffic safer"
    EFFICIENCY = "efficiency", "to save time, energy or money"
    USER_SATISFACTION = "user satisfaction", "to improve the experience of the users"


class TypeOfParticipants(CharacteristicValue):
    """The kinds of entity that take part directly in the processing of the data."""

    VEHICLE = "vehicle", "a car or another motor vehicle"
    VRU = "VRU", "a vulnerable road user (pedestrian, cyclist or motorcyclist)"
    ROAD_INFRASTRUCTURE = "road infrastructure", "equipment by the road: signs, signals, roadside ITS stations"
    REMOTE_INFRASTRUCTURE = "remote infrastructure", "equipment far from the road: a control centre, a cloud"


class NumberOfParticipants(CharacteristicValue):
    """The number of entities that take part directly in the processing of the data."""

    ONE = "one", "a single participant"
    TWO = "two", "exactly two participants"
    MULTIPLE = "multiple", "three or more participants"


class DataSourceEntity(CharacteristicValue):
    """The entity that originally produces the data in which the event is detected."""

    EVENT_SOURCE_ENTITY = "event source entity", "the data comes from the entity whose change of state is the event"
    EXTERNAL = "external", "the data comes from another entity"


class EventDetectionEntity(CharacteristicValue):
    """The entity that detects the event in the data."""

    EVENT_SOURCE_ENTITY = "event source entity", "the detecting entity is the one whose change of state is the event"
    DATA_SOURCE_ENTITY = "data source entity", "the detecting entity is the one that produces the data"
    EXTERNAL = "external", "the detecting entity is the source of neither the event nor the data"


class ActingEntity(CharacteristicValue):
    """The entity that carries out the action."""

    EVENT_DETECTION_ENTITY = "event detection entity", "the acting entity is the one that detects the event"
    EXTERNAL = "external", "the acting entity is another one"


class AffectedEntity(CharacteristicValue):
    """The entity that the action affects directly."""

    ACTING_ENTITY = "acting entity", "the action affects the entity that acts"
    EXTERNAL = "external", "the action affects another entity"


class ScopeOfImpact(CharacteristicValue):
    """The reach of the consequences of the action."""

    PARTICIPANT = "participant", "the consequences are limited to the participants"
    ENVIRONMENT = "environment", "the consequences reach the participants and their surroundings"
    BEYOND_ENVIRONMENT = (
        "beyond environment",
        "the consequences reach beyond the participants' surroundings, such as a whole fleet",
    )


class ObservationPeriod(CharacteristicValue):
    """The time span of the data that is needed to detect the event."""

    IMMEDIATE = "immediate", "a single sample is enough to detect the event"
    SHORT_TERM = "short-term", "the detection needs data of seconds to minutes"
    LONG_TERM = "long-term", "the detection needs data of hours or more"


class TimeSensitivity(CharacteristicValue):
    """The time until the action has its consequences."""

    IMMEDIATE = "immediate", "the consequences are immediate"
    SHORT_TERM = "short-term", "the consequences follow within seconds to minutes"
    LONG_TERM = "long-term", "the consequences follow after hours or later"


class Incidence(CharacteristicValue):
    """The frequency of the event and its action."""

    FREQUENT = "frequent", "often, as part of normal operation"
    COMMON = "common", "not often, but certain to occur"
    RARE = "rare", "seldom, as an exception"
    UNEXPECTED = "unexpected", "not expected to occur, though possible in theory"


class DetectionAlgorithm(CharacteristicValue):
    """The kind of algorithm that detects the event."""

    RULE_BASED = "rule-based", "rules or heuristics detect the event"
    LEARNING_BASED = "learning-based", "an algorithm learnt from data detects the event"


class TypeOfAction(CharacteristicValue):
    """The kind of action."""

    DATA_COLLECTION = "data collection", "the action records data"
    RECONFIGURATION = "reconfiguration", "the action changes the configuration of existing software"
    DEPLOYMENT = "deployment", "the action starts software that was not running"
    NOTIFICATION = "notification", "the action informs a person or a system"
    OTHER = "other", "any other action"


@dataclass(frozen=True)
class Dimension:
    """One of the dimensions."""

    name: str
    """The name in files, e.g. typeOfAction."""
    words: str
    """The name in prose, e.g. Type of Action."""
    values: type[CharacteristicValue]

    @property
    def definition(self) -> str:
        """The definition of the dimension."""
        return (self.values.__doc__ or "").strip()

    def described(self) -> str:
        """The definition with those of the values, as `kubectl explain` shows it."""
        return f"{self.definition} " + " ".join(f"{value.value}: {value.definition}." for value in self.values)


def _dimension(values: type[CharacteristicValue]) -> Dimension:
    name = values.__name__
    parts = "".join(f" {letter}" if letter.isupper() else letter for letter in name).split()
    words = " ".join(part.lower() if part == "Of" else part for part in parts)
    return Dimension(name[0].lower() + name[1:], words, values)


SCHEME = tuple(map(_dimension, CharacteristicValue.__subclasses__()))
"""All dimensions, in the order of the paper's Table 1, in which they are defined."""


def dimension_of(values: type[CharacteristicValue]) -> Dimension:
    """The dimension that has these values."""
    return next(dimension for dimension in SCHEME if dimension.values is values)


def _field(values: type[CharacteristicValue]) -> Any:
    description = dimension_of(values).described()
    return Field(default_factory=list, description=description, max_length=len(values), json_schema_extra=SET_LIST)


class Classification(Model):
    """The classification of the use case in the 13 dimensions of the scheme."""

    overarching_purpose: list[OverarchingPurpose] = _field(OverarchingPurpose)
    type_of_participants: list[TypeOfParticipants] = _field(TypeOfParticipants)
    number_of_participants: list[NumberOfParticipants] = _field(NumberOfParticipants)
    data_source_entity: list[DataSourceEntity] = _field(DataSourceEntity)
    event_detection_entity: list[EventDetectionEntity] = _field(EventDetectionEntity)
    acting_entity: list[ActingEntity] = _field(ActingEntity)
    affected_entity: list[AffectedEntity] = _field(AffectedEntity)
    scope_of_impact: list[ScopeOfImpact] = _field(ScopeOfImpact)
    observation_period: list[ObservationPeriod] = _field(ObservationPeriod)
    time_sensitivity: list[TimeSensitivity] = _field(TimeSensitivity)
    incidence: list[Incidence] = _field(Incidence)
    detection_algorithm: list[DetectionAlgorithm] = _field(DetectionAlgorithm)
    type_of_action: list[TypeOfAction] = _field(TypeOfAction)

    @field_validator("*")
    @classmethod
    def _once(cls, values: list[CharacteristicValue]) -> list[CharacteristicValue]:
        twice = [value for value in values if values.count(value) > 1]
        if twice:
            raise ValueError(f"{twice[0].value} is given twice: give it once")
        return values

    def to_json(self) -> dict[str, Any]:
        """The dimensions that have a value; empty ones are left out."""
        return {dimension: values for dimension, values in super().to_json().items() if values}

    def values_of(self, dimension: Dimension) -> list[CharacteristicValue]:
        """The values in a dimension of the scheme, in the order in which they are written."""
        values: list[CharacteristicValue] = getattr(self, to_snake(dimension.name))
        return values
