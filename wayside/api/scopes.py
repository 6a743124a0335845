"""The subjects of a rule: each client, pairs of clients, or the fleet; and the elements of `each`."""

from __future__ import annotations

from pydantic import ConfigDict, Field, model_validator

from wayside.api.base import (
    ClientName,
    Expression,
    Identifier,
    Model,
    ObjectName,
    PositiveDuration,
    map_list,
)
from wayside.api.constraints import constraint, exactly_one, unique
from wayside.api.freedata import bounded

_MAX_AGE = PositiveDuration("1s")


class Position(Model):
    """The position of a client: in metres in a common frame, or in degrees on the Earth."""

    constraints = (
        constraint(
            "has(self.x) == has(self.y) && has(self.latitude) == has(self.longitude)"
            " && !(has(self.x) && has(self.latitude)) && (!has(self.z) || has(self.x))",
            "give x and y (optionally z), or latitude and longitude",
            holds=lambda position: (
                {axis for axis in ("x", "y", "z", "latitude", "longitude") if getattr(position, axis) is not None}
                in (set(), {"x", "y"}, {"x", "y", "z"}, {"latitude", "longitude"})
            ),
        ),
    )

    stream: ObjectName
    """The stream whose newest sample contains the position. If x, y, latitude and longitude are all omitted, the
    stream's own position in the Detector is used."""
    x: Expression | None = None
    """CEL over msg: the position on the first axis in metres, e.g. msg.pose.position.x."""
    y: Expression | None = None
    """CEL over msg: the position on the second axis in metres."""
    z: Expression | None = None
    """CEL over msg: the position on the third axis in metres. Default: 0."""
    latitude: Expression | None = None
    """CEL over msg: the latitude in degrees north (WGS 84), e.g. msg.latitude."""
    longitude: Expression | None = None
    """CEL over msg: the longitude in degrees east (WGS 84), e.g. msg.longitude."""
    max_age: PositiveDuration | None = None
    """The maximum age of the newest sample. The position of a client is unknown if the sample is older, or if the
    stream is stale. Default: 1s; no limit if the stream never goes stale."""

    def max_age_ns(self, *, never_stale: bool) -> int | None:
        """The maximum age of a position in nanoseconds; None: no limit while its stream is not stale."""
        if self.max_age is not None:
            return self.max_age.ns
        return None if never_stale else _MAX_AGE.ns


class ClientScope(Model):
    """The rule is evaluated once for each client."""

    where: Expression | None = None
    """CEL over client, labels and streams. The rule applies only to clients for which it is true. An open episode ends
    with reason OutOfScope when it becomes false."""


class Role(Model):
    """Selects the clients for one side of a pair."""

    where: Expression
    """CEL over client, labels and streams. Only clients for which it is true can take this role. An open episode ends
    with reason OutOfScope when it becomes false."""


class PairsScope(Model):
    """The rule is evaluated once for each pair of clients.

    Without roles, a is the client with the smaller name. With a role, each ordered pair of clients that match is a
    subject.
    """

    position: Position
    """The position of a client."""
    within: float = Field(gt=0, le=1_000_000)
    """The maximum distance in metres at which a pair can start an episode. A pair with an open episode is always
    evaluated."""
    where: Expression | None = None
    """CEL over a, b, distance (metres) and closingSpeed (m/s). The rule applies only to pairs for which it is true. An
    open episode ends with reason OutOfScope when it becomes false."""
    a: Role | None = None
    """Selects the clients that can take role a. If a or b is set, pairs are ordered: car1+car2 and car2+car1 are
    separate subjects if both match."""
    b: Role | None = None
    """Selects the clients that can take role b. If a or b is set, pairs are ordered: car1+car2 and car2+car1 are
    separate subjects if both match."""
    max_pairs: int = Field(default=10_000, ge=1, le=1_000_000)
    """The maximum number of pairs per evaluation. At the limit, the nearest pairs are evaluated; the others are skipped
    and counted. A pair with an open episode, or whose `when` is already true, is always evaluated."""


class FleetScope(Model):
    """The rule is evaluated once for all clients together, even if there are none."""

    members: Expression
    """CEL over one client (client, labels, streams and the signals). Clients for which it is true are members; false
    and unknown are not."""


class Scope(Model):
    """The subjects of the rule: exactly one of the fields."""

    constraints = (exactly_one("client", "pairs", "fleet"),)

    client: ClientScope | None = None
    """Each client is a subject. The default."""
    pairs: PairsScope | None = None
    """Each pair of clients near each other is a subject."""
    fleet: FleetScope | None = None
    """All member clients together are one subject."""


MAXIMUM_FIELDS = 64
"""Of one element, its name included."""


class Element(Model):
    """One element of `each`: a name, and any fields that expressions use."""

    model_config = ConfigDict(
        extra="allow", json_schema_extra={"x-kubernetes-preserve-unknown-fields": True, "maxProperties": MAXIMUM_FIELDS}
    )

    name: ClientName
    """The name of the element. It is part of the subject, as in car1~north."""


class Each(Model):
    """The rule is evaluated once for each element."""

    constraints = (unique("of"),)

    as_: Identifier = Field(alias="as")
    """The name of the variable for the element in expressions, e.g. site."""
    of: list[Element] = Field(min_length=1, max_length=256, json_schema_extra=map_list("name"))
    """The elements. Each has a name and any other fields; at most 64 KiB in total."""

    @model_validator(mode="after")
    def _bounded(self) -> Each:
        for element in self.of:
            if (count := 1 + len(element.model_extra or {})) > MAXIMUM_FIELDS:
                raise ValueError(f"of: element {element.name} must have at most {MAXIMUM_FIELDS} fields; got {count}")
        try:
            bounded({element.name: element.model_extra or {} for element in self.of})
        except ValueError as error:
            raise ValueError(f"of: {error}") from None
        return self
