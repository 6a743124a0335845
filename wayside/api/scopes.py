"""Whom a rule is about: each client, pairs of clients, or the fleet; and the elements that it is evaluated for."""

from __future__ import annotations

from pydantic import ConfigDict, Field, model_validator

from wayside.api.base import ClientName, Expression, Identifier, Model, ObjectName, PositiveDuration, validations

_POSITION = "give x and y (and z, if it matters) in metres, or latitude and longitude in degrees"
_MAX_AGE = PositiveDuration("1s")
_SCOPE = "exactly one of client, pairs and fleet must be given"


class Position(Model):
    """Where a client is: in metres of one common frame, or on the Earth."""

    model_config = validations(
        (
            "has(self.x) == has(self.y) && has(self.latitude) == has(self.longitude)"
            " && has(self.x) != has(self.latitude) && (!has(self.z) || has(self.x))",
            _POSITION,
        ),
    )

    stream: ObjectName = Field(description="The stream whose newest sample tells the position.")
    x: Expression | None = Field(
        default=None, description="CEL over msg: metres along the first axis, e.g. msg.pose.position.x."
    )
    y: Expression | None = Field(default=None, description="CEL over msg: metres along the second axis.")
    z: Expression | None = Field(default=None, description="CEL over msg: metres along the third axis; 0 where absent.")
    latitude: Expression | None = Field(
        default=None, description="CEL over msg: degrees north (WGS 84), e.g. msg.latitude."
    )
    longitude: Expression | None = Field(
        default=None, description="CEL over msg: degrees east (WGS 84), e.g. msg.longitude."
    )
    max_age: PositiveDuration | None = Field(
        default=None,
        description="A client whose newest sample is older than this has no known position, as where the stream is "
        "stale. Default: 1s; no limit where the stream never goes stale.",
    )

    def max_age_ns(self, *, never_stale: bool) -> int | None:
        """When a position is too old to be believed, in nanoseconds; None: as long as its stream is not stale."""
        if self.max_age is not None:
            return self.max_age.ns
        return None if never_stale else _MAX_AGE.ns

    @model_validator(mode="after")
    def _complete(self) -> Position:
        given = frozenset(axis for axis in ("x", "y", "z", "latitude", "longitude") if getattr(self, axis) is not None)
        if given not in ({"x", "y"}, {"x", "y", "z"}, {"latitude", "longitude"}):
            raise ValueError(_POSITION)
        return self


class ClientScope(Model):
    """The rule is evaluated once for each client."""

    where: Expression | None = Field(
        default=None,
        description="CEL over client, labels and streams: only clients for which it is true. "
        "Turning false ends an open episode, reason OutOfScope.",
    )


class Role(Model):
    """Who can be the one or the other of a pair."""

    where: Expression = Field(
        description="CEL over client, labels and streams: only clients for which it is true. "
        "Turning false ends an open episode, reason OutOfScope."
    )


class PairsScope(Model):
    """The rule is evaluated once for each pair of clients.

    Without roles, a is the one with the smaller name. With a role, each ordered pair of clients that fit is a subject.
    """

    position: Position = Field(description="Where a client is.")
    within: float = Field(
        gt=0,
        le=1_000_000,
        description="Metres. Only pairs at most this far apart can start an episode; a pair with an open episode "
        "is always evaluated.",
    )
    where: Expression | None = Field(
        default=None,
        description="CEL over a, b, distance and closingSpeed: only pairs for which it is true. "
        "Turning false ends an open episode, reason OutOfScope.",
    )
    a: Role | None = Field(
        default=None, description="Who can be a. With a role, pairs are ordered, and each that fits is a subject."
    )
    b: Role | None = Field(
        default=None, description="Who can be b. With a role, pairs are ordered, and each that fits is a subject."
    )
    max_pairs: int = Field(
        default=10_000,
        ge=1,
        le=1_000_000,
        description="At most so many pairs within reach are looked at in one evaluation: the nearest. The others are "
        "left out and counted. Pairs with an open episode, or about to start one, always are.",
    )


class FleetScope(Model):
    """The rule is evaluated once for all clients together, also while there is none."""

    members: Expression = Field(
        description="CEL over one client (client, labels, streams and the signals): those for which it is true are "
        "members, those for which it is unknown are not."
    )


class Scope(Model):
    """Whom the rule is about: exactly one of the fields."""

    model_config = validations(
        ("[has(self.client), has(self.pairs), has(self.fleet)].filter(given, given).size() == 1", _SCOPE),
    )

    client: ClientScope | None = Field(default=None, description="Each client on its own. The default.")
    pairs: PairsScope | None = Field(default=None, description="Each pair of clients near each other.")
    fleet: FleetScope | None = Field(default=None, description="All clients that are members, together.")

    @model_validator(mode="after")
    def _exactly_one(self) -> Scope:
        if [self.client, self.pairs, self.fleet].count(None) != 2:
            raise ValueError(_SCOPE)
        return self


class Element(Model):
    """One of the things that a rule is evaluated for: its name, and whatever expressions need to know of it."""

    model_config = ConfigDict(extra="allow", json_schema_extra={"x-kubernetes-preserve-unknown-fields": True})

    name: ClientName = Field(description="Its name; it joins the subject, as in car1~north.")


class Each(Model):
    """The rule is evaluated once for each element."""

    as_: Identifier = Field(alias="as", description="The variable by which expressions use the element, e.g. site.")
    of: list[Element] = Field(
        min_length=1,
        max_length=256,
        description="The elements: a name each, and any other fields.",
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["name"]},
    )

    @model_validator(mode="after")
    def _unique_names(self) -> Each:
        names = [element.name for element in self.of]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"of: the name {twice[0]!r} is used twice: names must be unique")
        return self
