"""The classification of event-detection use cases: 13 dimensions, 39 characteristic values.

The scheme is that of Table 1 of Reiher et al., "Event Detection in C-ITS: Classification, Use Cases, and
Reference Implementation". A use case may fall on several values of one dimension, so each is a list.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any

from pydantic import Field

from wayside.api.base import Model


class OverarchingPurpose(StrEnum):
    """The goal that the use case serves."""

    SAFETY = "Safety"
    EFFICIENCY = "Efficiency"
    USER_SATISFACTION = "UserSatisfaction"


class TypeOfParticipants(StrEnum):
    """What kinds of entity take part in the processing of the data."""

    VEHICLE = "Vehicle"
    VRU = "VRU"
    ROAD_INFRASTRUCTURE = "RoadInfrastructure"
    REMOTE_INFRASTRUCTURE = "RemoteInfrastructure"


class NumberOfParticipants(StrEnum):
    """How many entities take part."""

    ONE = "One"
    TWO = "Two"
    MULTIPLE = "Multiple"


class DataSourceEntity(StrEnum):
    """Who first produces the data: the entity whose state changes, or another."""

    EVENT_SOURCE_ENTITY = "EventSourceEntity"
    EXTERNAL = "External"


class EventDetectionEntity(StrEnum):
    """Who detects the event in the data."""

    EVENT_SOURCE_ENTITY = "EventSourceEntity"
    DATA_SOURCE_ENTITY = "DataSourceEntity"
    EXTERNAL = "External"


class ActingEntity(StrEnum):
    """Who carries out the action."""

    EVENT_DETECTION_ENTITY = "EventDetectionEntity"
    EXTERNAL = "External"


class AffectedEntity(StrEnum):
    """Whom the action directly affects."""

    ACTING_ENTITY = "ActingEntity"
    EXTERNAL = "External"


class ScopeOfImpact(StrEnum):
    """How far the consequences of the action reach."""

    PARTICIPANT = "Participant"
    ENVIRONMENT = "Environment"
    BEYOND_ENVIRONMENT = "BeyondEnvironment"


class ObservationPeriod(StrEnum):
    """How much time the data must cover: one sample, seconds to minutes, or hours and longer."""

    IMMEDIATE = "Immediate"
    SHORT_TERM = "ShortTerm"
    LONG_TERM = "LongTerm"


class TimeSensitivity(StrEnum):
    """How soon the action shows its consequences: at once, in seconds to minutes, or in hours and later."""

    IMMEDIATE = "Immediate"
    SHORT_TERM = "ShortTerm"
    LONG_TERM = "LongTerm"


class Incidence(StrEnum):
    """How often the event and its action occur."""

    FREQUENT = "Frequent"
    COMMON = "Common"
    RARE = "Rare"
    UNEXPECTED = "Unexpected"


class DetectionAlgorithm(StrEnum):
    """Whether rules or a learned model detect the event."""

    RULE_BASED = "RuleBased"
    LEARNING_BASED = "LearningBased"


class TypeOfAction(StrEnum):
    """What the action does."""

    DATA_COLLECTION = "DataCollection"
    RECONFIGURATION = "Reconfiguration"
    DEPLOYMENT = "Deployment"
    NOTIFICATION = "Notification"
    OTHER = "Other"


def _dimension(values: type[StrEnum]) -> Any:
    return Field(
        default_factory=list,
        description=values.__doc__,
        max_length=len(values),
        json_schema_extra={"x-kubernetes-list-type": "set"},
    )


class Classification(Model):
    """Where the use case stands in the 13 dimensions of the classification scheme."""

    overarching_purpose: list[OverarchingPurpose] = _dimension(OverarchingPurpose)
    type_of_participants: list[TypeOfParticipants] = _dimension(TypeOfParticipants)
    number_of_participants: list[NumberOfParticipants] = _dimension(NumberOfParticipants)
    data_source_entity: list[DataSourceEntity] = _dimension(DataSourceEntity)
    event_detection_entity: list[EventDetectionEntity] = _dimension(EventDetectionEntity)
    acting_entity: list[ActingEntity] = _dimension(ActingEntity)
    affected_entity: list[AffectedEntity] = _dimension(AffectedEntity)
    scope_of_impact: list[ScopeOfImpact] = _dimension(ScopeOfImpact)
    observation_period: list[ObservationPeriod] = _dimension(ObservationPeriod)
    time_sensitivity: list[TimeSensitivity] = _dimension(TimeSensitivity)
    incidence: list[Incidence] = _dimension(Incidence)
    detection_algorithm: list[DetectionAlgorithm] = _dimension(DetectionAlgorithm)
    type_of_action: list[TypeOfAction] = _dimension(TypeOfAction)

    def to_json(self) -> dict[str, Any]:
        """The dimensions that have a value; empty ones are left out."""
        return {dimension: values for dimension, values in super().to_json().items() if values}
