"""The scheme by which use cases of event detection are classified: 13 dimensions, 39 characteristic values.

It is that of Table 1 of Reiher et al., "Event Detection in C-ITS: Classification, Use Cases, and Reference
Implementation", with the definitions in our own words. Whatever names a dimension or a value takes it from here: the
kinds, the catalog, the checks and docs/classification.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Self


class Value(StrEnum):
    """A characteristic value: as files have it, as people say it, and what it means."""

    words: str
    definition: str

    def __new__(cls, value: str, words: str, definition: str) -> Self:
        """The member is the text that files have."""
        member = str.__new__(cls, value)
        member._value_ = value
        member.words = words
        member.definition = definition
        return member

    def explained(self) -> str:
        """The value with its definition, as a diagnostic cites it."""
        return f"{self.value} ({self.definition})"


class OverarchingPurpose(Value):
    """The goal that the use case serves."""

    SAFETY = "Safety", "safety", "road traffic becomes safer"
    EFFICIENCY = "Efficiency", "efficiency", "something takes less time, energy or money"
    USER_SATISFACTION = "UserSatisfaction", "user satisfaction", "people are better off with what they use"


class TypeOfParticipants(Value):
    """What kinds of entity take part directly in the processing of the data."""

    VEHICLE = "Vehicle", "vehicle", "a car, or another vehicle with a motor"
    VRU = "VRU", "VRU", "a vulnerable road user: on foot, on a bicycle or on a motorcycle"
    ROAD_INFRASTRUCTURE = (
        "RoadInfrastructure",
        "road infrastructure",
        "what stands at the road: signs, signals, roadside ITS stations",
    )
    REMOTE_INFRASTRUCTURE = (
        "RemoteInfrastructure",
        "remote infrastructure",
        "what is far from the road: a control center, a cloud",
    )


class NumberOfParticipants(Value):
    """How many entities take part directly in the processing of the data."""

    ONE = "One", "one", "a single participant"
    TWO = "Two", "two", "exactly two participants"
    MULTIPLE = "Multiple", "multiple", "three participants or more"


class DataSourceEntity(Value):
    """Who first produces the data in which the event is detected."""

    EVENT_SOURCE_ENTITY = (
        "EventSourceEntity",
        "event source entity",
        "the entity whose own change of state is the event produces the data",
    )
    EXTERNAL = "External", "external", "another entity than the one whose state changes produces the data"


class EventDetectionEntity(Value):
    """Who finds the event in the data."""

    EVENT_SOURCE_ENTITY = (
        "EventSourceEntity",
        "event source entity",
        "the entity whose own change of state is the event detects it",
    )
    DATA_SOURCE_ENTITY = "DataSourceEntity", "data source entity", "the entity that produces the data detects the event"
    EXTERNAL = "External", "external", "an entity detects the event that is neither its source nor that of the data"


class ActingEntity(Value):
    """Who carries out the action."""

    EVENT_DETECTION_ENTITY = (
        "EventDetectionEntity",
        "event detection entity",
        "the entity that detects the event acts itself",
    )
    EXTERNAL = "External", "external", "another entity acts than the one that detects the event"


class AffectedEntity(Value):
    """Whom the consequences of the action reach directly."""

    ACTING_ENTITY = "ActingEntity", "acting entity", "the action directly affects the entity that acts"
    EXTERNAL = "External", "external", "the action directly affects another entity than the one that acts"


class ScopeOfImpact(Value):
    """How far the consequences of the action reach."""

    PARTICIPANT = "Participant", "participant", "the consequences stay with the participants"
    ENVIRONMENT = "Environment", "environment", "the consequences reach the participants and what is around them"
    BEYOND_ENVIRONMENT = (
        "BeyondEnvironment",
        "beyond environment",
        "the consequences reach farther than the participants' surroundings, such as a whole fleet",
    )


class ObservationPeriod(Value):
    """How much time the data covers in which the event is found."""

    IMMEDIATE = "Immediate", "immediate", "a certain sample is enough: the event follows at once"
    SHORT_TERM = "ShortTerm", "short-term", "it takes the data of some seconds up to minutes"
    LONG_TERM = "LongTerm", "long-term", "it takes the data of hours, or of longer"


class TimeSensitivity(Value):
    """How soon the action shows its consequences."""

    IMMEDIATE = "Immediate", "immediate", "the action has its consequences at once"
    SHORT_TERM = "ShortTerm", "short-term", "the consequences come within some seconds up to minutes"
    LONG_TERM = "LongTerm", "long-term", "the consequences come after hours, or later"


class Incidence(Value):
    """How often the event and its action occur."""

    FREQUENT = "Frequent", "frequent", "often: they belong to normal operation"
    COMMON = "Common", "common", "not often, but they are bound to come"
    RARE = "Rare", "rare", "seldom: it is something special"
    UNEXPECTED = "Unexpected", "unexpected", "never, as far as anybody expects, though in theory they could"


class DetectionAlgorithm(Value):
    """What finds the event."""

    RULE_BASED = "RuleBased", "rule-based", "rules and heuristics find the event"
    LEARNING_BASED = "LearningBased", "learning-based", "something that was learnt from data finds the event"


class TypeOfAction(Value):
    """What the action does."""

    DATA_COLLECTION = "DataCollection", "data collection", "data is recorded"
    RECONFIGURATION = "Reconfiguration", "reconfiguration", "software that is there already is configured anew"
    DEPLOYMENT = "Deployment", "deployment", "software is launched that did not run before"
    NOTIFICATION = "Notification", "notification", "somebody, or something, is told"
    OTHER = "Other", "other", "anything else"


@dataclass(frozen=True)
class Dimension:
    """One of the dimensions."""

    name: str
    """As files have it, e.g. typeOfAction."""
    words: str
    """As people say it, e.g. Type of Action."""
    values: type[Value]

    @property
    def definition(self) -> str:
        """What it tells of a use case."""
        return (self.values.__doc__ or "").strip()

    def described(self) -> str:
        """The definition with those of the values, as `kubectl explain` shows it."""
        return f"{self.definition} " + " ".join(f"{value.value}: {value.definition}." for value in self.values)


def _dimension(values: type[Value]) -> Dimension:
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
