"""The scheme by which use cases of event detection are classified: 13 dimensions, 39 characteristic values.

The scheme is Table 1 of Reiher et al., "Event Detection in C-ITS: Classification, Use Cases, and Reference
Implementation", with our own wording of the definitions. It is the single source of the names of dimensions and values
for the kinds, the catalog, the checks and docs/classification.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Self


class CharacteristicValue(StrEnum):
    """A characteristic value: its name in files, its name in prose, and its definition."""

    words: str
    definition: str

    def __new__(cls, value: str, words: str, definition: str) -> Self:
        """The member's text is its name in files."""
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

    SAFETY = "Safety", "safety", "to make road traffic safer"
    EFFICIENCY = "Efficiency", "efficiency", "to save time, energy or money"
    USER_SATISFACTION = "UserSatisfaction", "user satisfaction", "to improve the experience of the users"


class TypeOfParticipants(CharacteristicValue):
    """The kinds of entity that take part directly in the processing of the data."""

    VEHICLE = "Vehicle", "vehicle", "a car or another motor vehicle"
    VRU = "VRU", "VRU", "a vulnerable road user: on foot, on a bicycle or on a motorcycle"
    ROAD_INFRASTRUCTURE = (
        "RoadInfrastructure",
        "road infrastructure",
        "equipment at the road: signs, signals, roadside ITS stations",
    )
    REMOTE_INFRASTRUCTURE = (
        "RemoteInfrastructure",
        "remote infrastructure",
        "equipment far from the road: a control center, a cloud",
    )


class NumberOfParticipants(CharacteristicValue):
    """The number of entities that take part directly in the processing of the data."""

    ONE = "One", "one", "a single participant"
    TWO = "Two", "two", "exactly two participants"
    MULTIPLE = "Multiple", "multiple", "three or more participants"


class DataSourceEntity(CharacteristicValue):
    """The entity that originally produces the data in which the event is detected."""

    EVENT_SOURCE_ENTITY = (
        "EventSourceEntity",
        "event source entity",
        "the data comes from the entity whose change of state is the event",
    )
    EXTERNAL = "External", "external", "the data comes from another entity"


class EventDetectionEntity(CharacteristicValue):
    """The entity that detects the event in the data."""

    EVENT_SOURCE_ENTITY = (
        "EventSourceEntity",
        "event source entity",
        "the detecting entity is the one whose change of state is the event",
    )
    DATA_SOURCE_ENTITY = (
        "DataSourceEntity",
        "data source entity",
        ("the detecting entity is the one that produces the data"),
    )
    EXTERNAL = (
        "External",
        "external",
        "the detecting entity is neither the source of the event nor of the data",
    )


class ActingEntity(CharacteristicValue):
    """The entity that carries out the action."""

    EVENT_DETECTION_ENTITY = (
        "EventDetectionEntity",
        "event detection entity",
        "the acting entity is the one that detects the event",
    )
    EXTERNAL = "External", "external", "the acting entity is another one"


class AffectedEntity(CharacteristicValue):
    """The entity that the action affects directly."""

    ACTING_ENTITY = "ActingEntity", "acting entity", "the action affects the entity that acts"
    EXTERNAL = "External", "external", "the action affects another entity"


class ScopeOfImpact(CharacteristicValue):
    """The reach of the consequences of the action."""

    PARTICIPANT = "Participant", "participant", "the consequences are limited to the participants"
    ENVIRONMENT = "Environment", "environment", "the consequences reach the participants and their surroundings"
    BEYOND_ENVIRONMENT = (
        "BeyondEnvironment",
        "beyond environment",
        "the consequences reach beyond the participants' surroundings, such as a whole fleet",
    )


class ObservationPeriod(CharacteristicValue):
    """The time span of the data that is needed to detect the event."""

    IMMEDIATE = "Immediate", "immediate", "a single sample is enough to detect the event"
    SHORT_TERM = "ShortTerm", "short-term", "the detection needs data of seconds to minutes"
    LONG_TERM = "LongTerm", "long-term", "the detection needs data of hours or more"


class TimeSensitivity(CharacteristicValue):
    """The time until the action has its consequences."""

    IMMEDIATE = "Immediate", "immediate", "the consequences are immediate"
    SHORT_TERM = "ShortTerm", "short-term", "the consequences follow within seconds to minutes"
    LONG_TERM = "LongTerm", "long-term", "the consequences follow after hours or later"


class Incidence(CharacteristicValue):
    """The frequency of the event and its action."""

    FREQUENT = "Frequent", "frequent", "often, as part of normal operation"
    COMMON = "Common", "common", "not often, but certain to occur"
    RARE = "Rare", "rare", "seldom, as an exception"
    UNEXPECTED = "Unexpected", "unexpected", "not expected to occur, though possible in theory"


class DetectionAlgorithm(CharacteristicValue):
    """The kind of algorithm that detects the event."""

    RULE_BASED = "RuleBased", "rule-based", "rules or heuristics detect the event"
    LEARNING_BASED = "LearningBased", "learning-based", "an algorithm learnt from data detects the event"


class TypeOfAction(CharacteristicValue):
    """The kind of action."""

    DATA_COLLECTION = "DataCollection", "data collection", "the action records data"
    RECONFIGURATION = "Reconfiguration", "reconfiguration", "the action changes the configuration of existing software"
    DEPLOYMENT = "Deployment", "deployment", "the action starts software that was not running"
    NOTIFICATION = "Notification", "notification", "the action informs a person or a system"
    OTHER = "Other", "other", "any other action"


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


SCHEME = tuple(
    _dimension(values)
    for values in (
        OverarchingPurpose,
        TypeOfParticipants,
        NumberOfParticipants,
        DataSourceEntity,
        EventDetectionEntity,
        ActingEntity,
        AffectedEntity,
        ScopeOfImpact,
        ObservationPeriod,
        TimeSensitivity,
        Incidence,
        DetectionAlgorithm,
        TypeOfAction,
    )
)
"""All dimensions, in the order of the paper's Table 1."""
