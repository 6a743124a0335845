"""The classification of a rule's use case in the scheme: one or more values per dimension."""

from __future__ import annotations

from typing import Any

from pydantic import Field, field_validator
from pydantic.alias_generators import to_snake

from wayside.api.base import SET_LIST, Model
from wayside.api.scheme import (
    SCHEME,
    ActingEntity,
    AffectedEntity,
    CharacteristicValue,
    DataSourceEntity,
    DetectionAlgorithm,
    Dimension,
    EventDetectionEntity,
    Incidence,
    NumberOfParticipants,
    ObservationPeriod,
    OverarchingPurpose,
    ScopeOfImpact,
    TimeSensitivity,
    TypeOfAction,
    TypeOfParticipants,
)

_DESCRIPTIONS = {dimension.values: dimension.described() for dimension in SCHEME}


def _dimension(values: type[CharacteristicValue]) -> Any:
    return Field(
        default_factory=list,
        description=_DESCRIPTIONS[values],
        max_length=len(values),
        json_schema_extra=SET_LIST,
    )


class Classification(Model):
    """The classification of the use case in the 13 dimensions of the scheme."""

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

    @field_validator("*")
    @classmethod
    def _once(cls, values: list[CharacteristicValue]) -> list[CharacteristicValue]:
        twice = [value for value in values if values.count(value) > 1]
        if twice:
            raise ValueError(f"{twice[0].value} is given twice: remove one")
        return values

    def to_json(self) -> dict[str, Any]:
        """The dimensions that have a value; empty ones are left out."""
        return {dimension: values for dimension, values in super().to_json().items() if values}

    def values_of(self, dimension: Dimension) -> list[CharacteristicValue]:
        """The values in a dimension of the scheme, in the order in which they are written."""
        values: list[CharacteristicValue] = getattr(self, to_snake(dimension.name))
        return values
