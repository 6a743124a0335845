"""What a Detector says of its pod, or of its container in others' pods, which the application manager makes."""

from __future__ import annotations

from decimal import Decimal
from enum import StrEnum
from typing import Annotated

from pydantic import Field, model_validator

from wayside.api.base import Identifier, Model, ObjectName, PositiveQuantity, validations

_ONE = "give claim or size, not both"
_ONE_SOURCE = "give value or fromSecret, one of them"
_ANY_KEY = "without a key, operator must be Exists; with operator Exists there is no value"

RESERVED_VARIABLES = frozenset({"POD_NAME", "POD_NAMESPACE", "POD_UID"})
"""Environment variables by which the detector knows its pod."""
_RESERVED = f"{', '.join(sorted(RESERVED_VARIABLES))} are set for each pod by itself: leave them out"


class DetectorMode(StrEnum):
    """Who runs the detector."""

    STANDALONE = "Standalone"
    SIDECAR = "Sidecar"


MountPath = Annotated[str, Field(min_length=2, max_length=1024, pattern=r"^/[^:]+$")]
"""An absolute path in the pod."""

Amount = Annotated[str, Field(min_length=1, max_length=32, pattern=r"^[0-9]+(\.[0-9]+)?(m|k|M|G|T|Ki|Mi|Gi|Ti)?$")]
"""An amount of a resource in Kubernetes notation, such as 250m or 1Gi."""

Amounts = Annotated[
    dict[Annotated[str, Field(max_length=253)], Amount],
    Field(max_length=16),
]
"""By the resource's name: cpu, memory, ephemeral-storage or one of the cluster's own."""


class DetectorVolume(Model):
    """A volume, and where it is in the pod."""

    model_config = validations(("!(has(self.claim) && has(self.size))", _ONE))

    path: MountPath = Field(description="Where it is mounted, e.g. /var/lib/wayside.")
    claim: ObjectName | None = Field(
        default=None,
        description="A PersistentVolumeClaim of the namespace. Without it the volume lasts as long as the pod.",
    )
    size: PositiveQuantity | None = Field(
        default=None, description="Without a claim: at most so much; a pod that writes more is evicted. Default: any."
    )

    @model_validator(mode="after")
    def _one(self) -> DetectorVolume:
        if self.claim is not None and self.size is not None:
            raise ValueError(_ONE)
        return self


class DetectorResources(Model):
    """What is set aside for the detector, and what it may take at most."""

    requests: Amounts = Field(
        default_factory=lambda: {"cpu": "100m", "memory": "256Mi"},
        description="What a node must have free. Default: cpu 100m, memory 256Mi.",
    )
    limits: Amounts = Field(
        default_factory=lambda: {"memory": "1Gi"},
        description="What it may take at most. Its memory must hold the buffer (spec.buffer.bytes) and some 200Mi. "
        "Default: memory 1Gi.",
    )

    @model_validator(mode="after")
    def _fits(self) -> DetectorResources:
        """What the API server would refuse the whole pod for."""
        for field, amounts in (("requests", self.requests), ("limits", self.limits)):
            for name in amounts:
                if name not in _RESOURCES and "/" not in name:
                    raise ValueError(
                        f"{field}: {name!r} is no resource: give {', '.join(_RESOURCES)}, or one of the cluster's own, "
                        "such as example.com/gpu"
                    )
        for name, amount in self.requests.items():
            limit = self.limits.get(name)
            if limit is not None and _amount(amount) > _amount(limit):
                raise ValueError(f"requests.{name}: {amount} is more than limits.{name}, {limit}: raise the limit")
            if "/" in name and (limit is None or _amount(amount) != _amount(limit)):
                raise ValueError(f"requests.{name}: {amount} must be the same as limits.{name}: give both alike")
        return self


_RESOURCES = ("cpu", "memory", "ephemeral-storage")
_UNITS: dict[str, Decimal] = {"m": Decimal("0.001"), "k": Decimal(10**3), "M": Decimal(10**6), "G": Decimal(10**9)} | {
    "T": Decimal(10**12), "Ki": Decimal(2**10), "Mi": Decimal(2**20), "Gi": Decimal(2**30), "Ti": Decimal(2**40)
}  # fmt: skip


def _amount(text: str) -> Decimal:
    number = text.rstrip("mkKMGTi")
    return Decimal(number) * _UNITS.get(text[len(number) :], 1)


class SecretKey(Model):
    """An entry of a Secret."""

    name: ObjectName = Field(description="The Secret, of the Detector's namespace.")
    key: Annotated[str, Field(min_length=1, max_length=253, pattern=r"^[-._A-Za-z0-9]+$")] = Field(
        description="Its entry."
    )


class DetectorVariable(Model):
    """An environment variable."""

    model_config = validations(
        ("has(self.value) != has(self.fromSecret)", _ONE_SOURCE),
        (f"!(self.name in {sorted(RESERVED_VARIABLES)})".replace("'", '"'), _RESERVED),
    )

    name: Identifier = Field(description="Its name, e.g. OTEL_RESOURCE_ATTRIBUTES.")
    value: Annotated[str, Field(max_length=4096)] | None = Field(default=None, description="What it says.")
    from_secret: SecretKey | None = Field(
        default=None, description="Where to take it from. Without that Secret the detector does not start."
    )

    @model_validator(mode="after")
    def _consistent(self) -> DetectorVariable:
        if (self.value is None) == (self.from_secret is None):
            raise ValueError(_ONE_SOURCE)
        if self.name in RESERVED_VARIABLES:
            raise ValueError(_RESERVED)
        return self


class TolerationOperator(StrEnum):
    """How a taint's value is looked at."""

    EQUAL = "Equal"
    EXISTS = "Exists"


class TaintEffect(StrEnum):
    """What a taint does to pods that do not tolerate it."""

    NO_SCHEDULE = "NoSchedule"
    PREFER_NO_SCHEDULE = "PreferNoSchedule"
    NO_EXECUTE = "NoExecute"


class DetectorToleration(Model):
    """A taint of nodes on which the detector may run nevertheless, as pods have it."""

    model_config = validations(
        (
            "(has(self.key) || (has(self.operator) && self.operator == 'Exists')) && "
            "!(has(self.value) && has(self.operator) && self.operator == 'Exists')",
            _ANY_KEY,
        )
    )

    key: Annotated[str, Field(min_length=1, max_length=317)] | None = Field(
        default=None, description="The taint's key. Default: any, with operator Exists."
    )
    operator: TolerationOperator | None = Field(
        default=None, description="Whether the value must be equal, or anything will do. Default: Equal."
    )
    value: Annotated[str, Field(max_length=63)] | None = Field(default=None, description="The taint's value.")
    effect: TaintEffect | None = Field(default=None, description="The taint's effect. Default: any.")
    toleration_seconds: Annotated[int, Field(ge=0, le=2**31 - 1)] | None = Field(
        default=None, description="How long it stays on a node with effect NoExecute. Default: for ever."
    )

    @model_validator(mode="after")
    def _consistent(self) -> DetectorToleration:
        exists = self.operator is TolerationOperator.EXISTS
        if (self.key is None and not exists) or (exists and self.value is not None):
            raise ValueError(_ANY_KEY)
        return self


class DetectorPod(Model):
    """The pod, or the container in others' pods.

    A change of it, or of where the Detector keeps files and Secrets, starts a Standalone detector anew. Pods that have
    the detector as a sidecar keep it as it is.
    """

    image: Annotated[str, Field(min_length=1, max_length=512, pattern=r"^[^\s]+$")] | None = Field(
        default=None, description="The image. Default: that of the manager's option --detector-image."
    )
    resources: DetectorResources = Field(
        default_factory=DetectorResources, description="What is set aside for it, and what it may take at most."
    )
    node_selector: dict[Annotated[str, Field(max_length=317)], Annotated[str, Field(max_length=63)]] = Field(
        default_factory=dict,
        max_length=16,
        description="Labels of the nodes on which it may run. Not with mode Sidecar.",
    )
    tolerations: list[DetectorToleration] = Field(
        default_factory=list,
        max_length=16,
        description="Taints of nodes on which it may run.",
        json_schema_extra={"x-kubernetes-list-type": "atomic"},
    )
    env: list[DetectorVariable] = Field(
        default_factory=list,
        max_length=64,
        description="Environment variables, beside and before those of the manager's option --detector-env.",
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["name"]},
    )
    volumes: list[DetectorVolume] = Field(
        default_factory=list,
        max_length=16,
        description="Volumes for the folders of state, recordings and the database's spool and files: each of these "
        "that is in none of them gets one that lasts as long as the pod.",
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["path"]},
    )
    secrets: list[ObjectName] = Field(
        default_factory=list,
        max_length=32,
        description="The Secrets that rules may use. Those that the Detector names for itself are not among them, "
        "unless they stand here too. Who writes rules can send what they hold to others.",
        json_schema_extra={"x-kubernetes-list-type": "set"},
    )

    @model_validator(mode="after")
    def _unique(self) -> DetectorPod:
        paths = [each.path for each in self.volumes]
        variables = [each.name for each in self.env]
        for field, names in (("volumes", paths), ("secrets", self.secrets), ("env", variables)):
            twice = sorted({each for each in names if names.count(each) > 1})
            if twice:
                raise ValueError(f"{field}: {twice[0]} is given twice: give it once")
        return self
