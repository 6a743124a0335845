"""When a rule is evaluated: at whole multiples of a period, at each sample of a stream, or on request."""

from __future__ import annotations

from pydantic import Field, model_validator

from wayside.api.base import Duration, Model, ObjectName
from wayside.api.constraints import checked, constraint

DEFAULT_PERIOD = Duration("1s")
"""The default period of a rule."""


class Evaluation(Model):
    """When the rule is evaluated: at most one of every, onSample and onDemand."""

    constraints = (
        constraint(
            "[has(self.every), has(self.onSample), has(self.onDemand)].filter(given, given).size() <= 1",
            "give at most one of every, onSample and onDemand",
            holds=lambda when: (when.every, when.on_sample, when.on_demand).count(None) >= 2,
        ),
    )

    every: Duration | None = Field(
        default=None, json_schema_extra=checked("duration(self) >= duration('10ms')", "give 10ms or more")
    )
    """Evaluate the rule at whole multiples of this period, 10ms or more. Default: 1s."""
    on_sample: ObjectName | None = None
    """Evaluate the rule at each sample of this stream, for the subjects of the sample's client, and whenever a `for`, a
    cooldown or an unknownTimeout expires."""
    on_demand: bool | None = Field(default=None, json_schema_extra=checked("self", "write true, or leave it out"))
    """If true, evaluate the rule only on request."""
    priority: int = Field(default=0, ge=-1_000, le=1_000)
    """Under overload, the detector evaluates rules of lower priority less often, the lowest first."""

    @property
    def period_ns(self) -> int | None:
        """The period in nanoseconds; None where the rule has none."""
        if self.on_sample is not None or self.on_demand:
            return None
        return (self.every or DEFAULT_PERIOD).ns

    @model_validator(mode="after")
    def _consistent(self) -> Evaluation:
        if self.every is not None and self.every.ns < 10_000_000:
            raise ValueError(f"every: {self.every} is too short: give 10ms or more")
        if self.on_demand is False:
            raise ValueError("onDemand: write true, or leave it out")
        return self
