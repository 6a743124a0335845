"""When a rule is evaluated: at whole multiples of a time, with each sample of a stream, or when somebody asks."""

from __future__ import annotations

from pydantic import Field, model_validator

from wayside.api.base import Duration, Model, ObjectName, validations

DEFAULT_PERIOD = Duration("1s")
"""How often a rule is evaluated that does not say when."""


class Evaluation(Model):
    """When the rule is evaluated: at most one of every, onSample and onDemand."""

    model_config = validations(
        ("!has(self.every) || duration(self.every) >= duration('10ms')", "every: give 10ms or more"),
        (
            "[has(self.every), has(self.onSample), has(self.onDemand)].filter(given, given).size() <= 1",
            "give at most one of every, onSample and onDemand",
        ),
        ("!has(self.onDemand) || self.onDemand", "onDemand: write true, or leave it out"),
    )

    every: Duration | None = Field(
        default=None,
        description="The rule is evaluated at each whole multiple of this; 10ms at the least. Default: 1s.",
    )
    on_sample: ObjectName | None = Field(
        default=None,
        description="The rule is evaluated with each sample of this stream, for the subjects that its client belongs "
        "to, and when a for, a cooldown or the unknownTimeout is over.",
    )
    on_demand: bool | None = Field(
        default=None, description="true: the rule is evaluated only when somebody asks for it."
    )
    priority: int = Field(
        default=0,
        ge=-1_000,
        le=1_000,
        description="When the evaluation falls behind, rules of lower priority are evaluated less often first.",
    )

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
        if sum(given is not None for given in (self.every, self.on_sample, self.on_demand)) > 1:
            raise ValueError("give at most one of every, onSample and onDemand")
        if self.on_demand is False:
            raise ValueError("onDemand: write true, or leave it out")
        return self
