"""The detector's pod, or its container in other pods, which the application manager creates."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import Field, model_validator

from wayside.api.base import Identifier, Model, ObjectName, PositiveQuantity, Quantity, validations

_ONE = "give claim or size, not both"
_ONE_SOURCE = "give exactly one of value and fromSecret"
_ANY_KEY = "without key, operator must be Exists; with operator Exists, remove value"

RESERVED_VARIABLES = frozenset({"POD_NAME", "POD_NAMESPACE", "POD_UID"})
"""Environment variables by which the detector knows its pod."""
_RESERVED = f"{', '.join(sorted(RESERVED_VARIABLES))} are set automatically in each pod: remove them"


class DetectorMode(StrEnum):
    """How the detector is run."""

    STANDALONE = "Standalone"
    SIDECAR = "Sidecar"


MountPath = Annotated[str, Field(min_length=2, max_length=1024, pattern=r"^/[^:]+$")]
"""An absolute path in the pod."""

Amounts = Annotated[
    dict[Annotated[str, Field(max_length=253)], Quantity],
    Field(max_length=16),
]
"""By the resource's name: cpu, memory, ephemeral-storage or one of the cluster's own."""


class DetectorVolume(Model):
    """A volume and its mount path."""

    model_config = validations(("!(has(self.claim) && has(self.size))", _ONE, ".size", "Forbidden"))

    path: MountPath = Field(description="The mount path, e.g. /var/lib/wayside.")
    claim: ObjectName | None = Field(
        default=None,
        description="The name of a PersistentVolumeClaim in the namespace. Without it, the volume is removed with the "
        "pod.",
    )
    size: PositiveQuantity | None = Field(
        default=None,
        description="Without a claim: the maximum size of the volume. A pod that writes more is evicted. Default: no "
        "limit.",
    )

    @model_validator(mode="after")
    def _one(self) -> DetectorVolume:
        if self.claim is not None and self.size is not None:
            raise ValueError(_ONE)
        return self


class DetectorResources(Model):
    """The compute resources of the detector: requests and limits."""

    requests: Amounts = Field(
        default_factory=lambda: {"cpu": Quantity("100m"), "memory": Quantity("256Mi")},
        description="The resources that a node must have available. Default: cpu 100m, memory 256Mi.",
    )
    limits: Amounts = Field(
        default_factory=lambda: {"memory": Quantity("1Gi")},
        description="The maximum resources. The memory limit must cover the buffer (spec.buffer.bytes) plus some "
        "200Mi. Default: memory 1Gi.",
    )

    @model_validator(mode="after")
    def _fits(self) -> DetectorResources:
        """Checks for which the API server would refuse the whole pod."""
        for field, amounts in (("requests", self.requests), ("limits", self.limits)):
            for name in amounts:
                if name not in _RESOURCES and "/" not in name:
                    raise ValueError(
                        f"{field}: {name!r} is not a resource: use {', '.join(_RESOURCES)}, or an extended resource, "
                        "such as example.com/gpu"
                    )
        for name, amount in self.requests.items():
            limit = self.limits.get(name)
            if limit is not None and amount.value > limit.value:
                raise ValueError(f"requests.{name}: {amount} is more than limits.{name}, {limit}: raise the limit")
            if "/" in name and (limit is None or amount.value != limit.value):
                raise ValueError(f"requests.{name}: {amount} must equal limits.{name}: set both to the same amount")
        return self


_RESOURCES = ("cpu", "memory", "ephemeral-storage")


class SecretKey(Model):
    """A key of a Secret."""

    name: ObjectName = Field(description="The name of the Secret, in the namespace of the Detector.")
    key: Annotated[str, Field(min_length=1, max_length=253, pattern=r"^[-._A-Za-z0-9]+$")] = Field(
        description="The key in the Secret."
    )


class DetectorVariable(Model):
    """An environment variable."""

    model_config = validations(
        ("has(self.value) != has(self.fromSecret)", _ONE_SOURCE),
        (f"!(self.name in {sorted(RESERVED_VARIABLES)})".replace("'", '"'), _RESERVED, ".name", "Forbidden"),
    )

    name: Identifier = Field(description="The name of the variable, e.g. OTEL_RESOURCE_ATTRIBUTES.")
    value: Annotated[str, Field(max_length=4096)] | None = Field(default=None, description="The literal value.")
    from_secret: SecretKey | None = Field(
        default=None,
        description="The Secret key that contains the value. The detector does not start without that Secret.",
    )

    @model_validator(mode="after")
    def _consistent(self) -> DetectorVariable:
        if (self.value is None) == (self.from_secret is None):
            raise ValueError(_ONE_SOURCE)
        if self.name in RESERVED_VARIABLES:
            raise ValueError(_RESERVED)
        return self


class TolerationOperator(StrEnum):
    """How a toleration matches the value of a taint."""

    EQUAL = "Equal"
    EXISTS = "Exists"


class TaintEffect(StrEnum):
    """The effect of a taint on pods that do not tolerate it."""

    NO_SCHEDULE = "NoSchedule"
    PREFER_NO_SCHEDULE = "PreferNoSchedule"
    NO_EXECUTE = "NoExecute"


class DetectorToleration(Model):
    """A toleration of a node taint, as in a PodSpec."""

    model_config = validations(
        (
            "(has(self.key) || (has(self.operator) && self.operator == 'Exists')) && "
            "!(has(self.value) && has(self.operator) && self.operator == 'Exists')",
            _ANY_KEY,
            ".operator",
        )
    )

    key: Annotated[str, Field(min_length=1, max_length=317)] | None = Field(
        default=None, description="The taint key. Default, with operator Exists: every key."
    )
    operator: TolerationOperator | None = Field(
        default=None, description="Equal: the values must match. Exists: any value matches. Default: Equal."
    )
    value: Annotated[str, Field(max_length=63)] | None = Field(
        default=None, description="The taint value. Not with operator Exists."
    )
    effect: TaintEffect | None = Field(default=None, description="The taint effect. Default: every effect.")
    toleration_seconds: Annotated[int, Field(ge=0, le=2**31 - 1)] | None = Field(
        default=None,
        description="How long the pod stays on a node with effect NoExecute, in seconds. Default: forever.",
    )

    @model_validator(mode="after")
    def _consistent(self) -> DetectorToleration:
        exists = self.operator is TolerationOperator.EXISTS
        if (self.key is None and not exists) or (exists and self.value is not None):
            raise ValueError(_ANY_KEY)
        return self


class DetectorPod(Model):
    """The pod, or the container in others' pods.

    A change of it, or of the paths of files and Secrets in the Detector, restarts a Standalone detector. Pods that have
    the detector as a sidecar keep it as it is.
    """

    image: Annotated[str, Field(min_length=1, max_length=512, pattern=r"^[^\s]+$")] | None = Field(
        default=None, description="The image. Default: the value of the manager's option --detector-image."
    )
    resources: DetectorResources = Field(
        default_factory=DetectorResources, description="The compute resources of the detector: requests and limits."
    )
    node_selector: dict[Annotated[str, Field(max_length=317)], Annotated[str, Field(max_length=63)]] = Field(
        default_factory=dict,
        max_length=16,
        description="The labels that a node must have. Not with mode Sidecar.",
    )
    tolerations: list[DetectorToleration] = Field(
        default_factory=list,
        max_length=16,
        description="The node taints that the pod tolerates. Not with mode Sidecar.",
        json_schema_extra={"x-kubernetes-list-type": "atomic"},
    )
    env: list[DetectorVariable] = Field(
        default_factory=list,
        max_length=64,
        description="Environment variables. They are added to those of the manager's option --detector-env and take "
        "precedence over them.",
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["name"]},
    )
    volumes: list[DetectorVolume] = Field(
        default_factory=list,
        max_length=16,
        description="Volumes for the folders of the state, the recordings, the database spool and the database files. "
        "A folder that is on none of these volumes gets one that is removed with the pod.",
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["path"]},
    )
    secrets: list[ObjectName] = Field(
        default_factory=list,
        max_length=32,
        description="The Secrets that rules may use. A Secret that the Detector itself refers to is available to "
        "rules only if it is listed here as well. Anyone who can write rules can send the contents of these Secrets "
        "elsewhere.",
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
