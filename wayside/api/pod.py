"""The detector's pod, or its container in other pods, which the application manager creates."""

from __future__ import annotations

import re
from enum import StrEnum
from typing import Annotated, Any

from pydantic import AfterValidator, ConfigDict, Field, model_validator
from pydantic.alias_generators import to_snake

from wayside.api.base import (
    ATOMIC_LIST,
    ATOMIC_MAP,
    LABEL,
    SET_LIST,
    Identifier,
    Model,
    PositiveQuantity,
    Quantity,
    SubdomainName,
    map_list,
)
from wayside.api.constraints import GIVEN_TWICE, constraint, exactly_one, unique
from wayside.api.freedata import of_bounded_size
from wayside.api.selector import LabelKey, LabelValue

_OWN_VOLUMES = "^(scratch|metrics|token|folder-[0-9]+|secret-[0-9]+)$"

VOLUME_PREFIX = "wayside-"
"""Of the names of the detector's volumes in others' pods."""

VolumeName = Annotated[str, Field(min_length=1, max_length=63 - len(VOLUME_PREFIX), pattern=f"^{LABEL}$")]
"""The name of a volume: with the prefix, it is still a label."""

RESERVED_VARIABLES = frozenset({"POD_NAME", "POD_NAMESPACE", "POD_UID"})
"""Environment variables that identify the detector's pod."""


class DetectorMode(StrEnum):
    """How the detector is run."""

    STANDALONE = "Standalone"
    SIDECAR = "Sidecar"


Embedded = Annotated[
    dict[str, Any],
    Field(json_schema_extra={"type": "object", "x-kubernetes-preserve-unknown-fields": True, "maxProperties": 64}),
    AfterValidator(of_bounded_size),
]
"""A part of a PodSpec that the API server checks with the pod."""

MountPath = Annotated[str, Field(min_length=2, max_length=1024, pattern=r"^/[^:]+$")]
"""An absolute path in the pod."""

Amounts = Annotated[
    dict[Annotated[str, Field(max_length=253)], Quantity],
    Field(max_length=16),
]
"""Amounts by resource: cpu, memory, ephemeral-storage or an extended resource."""


class DetectorVolume(Model):
    """A volume, as in a PodSpec, with one of these sources."""

    constraints = (
        exactly_one("persistent_volume_claim", "ephemeral", "empty_dir", "config_map", "secret", "projected", "csi"),
        constraint(
            f"!self.name.matches('{_OWN_VOLUMES}')",
            "the names scratch, metrics, token, folder-<n> and secret-<n> are reserved: choose another name",
            ".name",
            "Forbidden",
            holds=lambda volume: re.match(_OWN_VOLUMES, volume.name) is None,
        ),
    )

    name: VolumeName
    """The name of the volume."""
    persistent_volume_claim: Embedded | None = None
    """A PersistentVolumeClaim in the namespace: claimName, readOnly."""
    ephemeral: Embedded | None = None
    """A claim that is created and deleted with the pod: volumeClaimTemplate."""
    empty_dir: Embedded | None = None
    """A folder that is removed with the pod: sizeLimit, medium."""
    config_map: Embedded | None = None
    """Files from a ConfigMap: name, items, defaultMode, optional."""
    secret: Embedded | None = None
    """Files from a Secret: secretName, items, defaultMode, optional."""
    projected: Embedded | None = None
    """Files from several sources: sources, defaultMode."""
    csi: Embedded | None = None
    """A volume of a CSI driver: driver, volumeAttributes, readOnly."""


class DetectorVolumeMount(Model):
    """The mount of a volume, as in a PodSpec."""

    name: VolumeName
    """The name of the volume."""
    mount_path: MountPath
    """The path in the container, e.g. /var/lib/wayside."""
    sub_path: Annotated[str, Field(min_length=1, max_length=1024)] | None = None
    """A path within the volume. Default: its root."""
    read_only: bool = False
    """If true, the container cannot write to it."""


class DetectorResources(Model):
    """The compute resources of the detector: requests and limits."""

    requests: Amounts = Field(default_factory=lambda: {"cpu": Quantity("100m"), "memory": Quantity("256Mi")})
    """The resources that a node must have available. Default: cpu 100m, memory 256Mi."""
    limits: Amounts = Field(default_factory=lambda: {"memory": Quantity("1Gi")})
    """The maximum resources. The memory limit must cover the buffer (spec.buffer.bytes) plus about 200Mi. Default:
    memory 1Gi."""

    @model_validator(mode="after")
    def _fits(self) -> DetectorResources:
        """Refuse resources that the API server would refuse in the pod."""
        for field, amounts in (("requests", self.requests), ("limits", self.limits)):
            for name in amounts:
                if name not in _RESOURCES and "/" not in name:
                    raise ValueError(
                        f"{field}: must be {', '.join(_RESOURCES)} or an extended resource, such as example.com/gpu; "
                        f"got {name!r}"
                    )
        for name, amount in self.requests.items():
            limit = self.limits.get(name)
            if limit is not None and amount.value > limit.value:
                raise ValueError(f"requests.{name}: must be at most limits.{name}, {limit}; got {amount}")
            if "/" in name and (limit is None or amount.value != limit.value):
                raise ValueError(
                    f"requests.{name}: must equal limits.{name}; got {amount}: set both to the same amount"
                )
        return self


_RESOURCES = ("cpu", "memory", "ephemeral-storage")


class KeySelector(Model):
    """A key of a Secret or ConfigMap, as in a PodSpec."""

    model_config = ConfigDict(json_schema_extra=ATOMIC_MAP)

    name: SubdomainName
    """The name of the object, in the namespace of the Detector."""
    key: Annotated[str, Field(min_length=1, max_length=253, pattern=r"^[-._A-Za-z0-9]+$")]
    """The key in the object."""
    optional: bool | None = None
    """If true, the detector starts without the object or the key. Default: false."""


class FieldSelector(Model):
    """A field of the pod, as in a PodSpec."""

    model_config = ConfigDict(json_schema_extra=ATOMIC_MAP)

    field_path: Annotated[str, Field(min_length=1, max_length=317)]
    """The path of the field, e.g. spec.nodeName."""


class ResourceSelector(Model):
    """A resource of the detector's container, as in a PodSpec."""

    model_config = ConfigDict(json_schema_extra=ATOMIC_MAP)

    resource: Annotated[str, Field(min_length=1, max_length=317)]
    """The resource, e.g. limits.memory."""
    divisor: PositiveQuantity | None = None
    """The unit of the value. Default: 1."""


class VariableSource(Model):
    """The source of a variable's value, as in a PodSpec."""

    constraints = (exactly_one("secret_key_ref", "config_map_key_ref", "field_ref", "resource_field_ref"),)

    secret_key_ref: KeySelector | None = None
    """A key of a Secret."""
    config_map_key_ref: KeySelector | None = None
    """A key of a ConfigMap."""
    field_ref: FieldSelector | None = None
    """A field of the pod."""
    resource_field_ref: ResourceSelector | None = None
    """A request or limit of the detector's container."""


class DetectorVariable(Model):
    """An environment variable, as in a PodSpec."""

    constraints = (
        exactly_one("value", "value_from"),
        constraint(
            f"!(self.name in {sorted(RESERVED_VARIABLES)})".replace("'", '"'),
            f"{', '.join(sorted(RESERVED_VARIABLES))} are set automatically in each pod: remove them",
            ".name",
            "Forbidden",
            holds=lambda variable: variable.name not in RESERVED_VARIABLES,
        ),
    )

    name: Identifier
    """The name of the variable, e.g. OTEL_RESOURCE_ATTRIBUTES."""
    value: Annotated[str, Field(max_length=4096)] | None = None
    """The literal value."""
    value_from: VariableSource | None = None
    """The source of the value."""


class ObjectNameReference(Model):
    """A reference to an object of the same namespace."""

    model_config = ConfigDict(json_schema_extra=ATOMIC_MAP)

    name: SubdomainName
    """The name of the object."""


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

    constraints = (
        constraint(
            "(has(self.key) || (has(self.operator) && self.operator == 'Exists')) && "
            "!(has(self.value) && has(self.operator) && self.operator == 'Exists')",
            "without key, operator must be Exists; with operator Exists, value must be absent",
            ".operator",
            holds=lambda toleration: (
                toleration.value is None if toleration.operator == "Exists" else toleration.key is not None
            ),
        ),
    )

    key: LabelKey | None = None
    """The taint key. Default, with operator Exists: every key."""
    operator: TolerationOperator | None = None
    """Equal: the values must match. Exists: any value matches. Default: Equal."""
    value: LabelValue | None = None
    """The taint value. Not with operator Exists."""
    effect: TaintEffect | None = None
    """The taint effect. Default: every effect."""
    toleration_seconds: Annotated[int, Field(ge=0, le=2**31 - 1)] | None = None
    """With effect NoExecute: how long the pod stays on a node with the taint, in seconds. Default: forever."""


class DetectorPod(Model):
    """The pod of the detector, or its container in other pods.

    A change of the pod, or of the paths of files and Secrets in the Detector, restarts a Standalone detector. Existing
    pods keep their sidecar unchanged.
    """

    constraints = (
        unique("volumes", "secret_names", "env", "image_pull_secrets", wording=GIVEN_TWICE),
        unique("volume_mounts", by="mount_path", wording=GIVEN_TWICE),
    )

    image: Annotated[str, Field(min_length=1, max_length=512, pattern=r"^[^\s]+$")] | None = None
    """The image. Default: the value of the manager's option --detector-image."""
    resources: DetectorResources = Field(default_factory=DetectorResources)
    """The compute resources of the detector: requests and limits."""
    node_selector: dict[LabelKey, LabelValue] = Field(default_factory=dict, max_length=16, json_schema_extra=ATOMIC_MAP)
    """The labels that a node must have. Not with mode Sidecar."""
    affinity: Embedded | None = None
    """The affinity to nodes and other pods, as in a PodSpec. Not with mode Sidecar."""
    tolerations: list[DetectorToleration] = Field(default_factory=list, max_length=16, json_schema_extra=ATOMIC_LIST)
    """The node taints that the pod tolerates. Not with mode Sidecar."""
    priority_class_name: SubdomainName | None = None
    """The PriorityClass of the pod. Not with mode Sidecar."""
    runtime_class_name: SubdomainName | None = None
    """The RuntimeClass of the pod. Not with mode Sidecar."""
    image_pull_secrets: list[ObjectNameReference] = Field(
        default_factory=list, max_length=16, json_schema_extra=map_list("name")
    )
    """The Secrets to pull the image with, in addition to those of the manager's option --detector-pull-secret."""
    security_context: Embedded | None = None
    """Fields of the pod's security context, as in a PodSpec, e.g. fsGroup. They override the defaults. The defaults
    meet the restricted Pod Security Standard. Not with mode Sidecar."""
    env: list[DetectorVariable] = Field(default_factory=list, max_length=64, json_schema_extra=map_list("name"))
    """Environment variables, in addition to those of the manager's option --detector-env. They take precedence over
    variables of the same name there."""
    volumes: list[DetectorVolume] = Field(default_factory=list, max_length=16, json_schema_extra=map_list("name"))
    """Volumes for volumeMounts."""
    volume_mounts: list[DetectorVolumeMount] = Field(
        default_factory=list, max_length=16, json_schema_extra=map_list("mountPath")
    )
    """The mounts of the volumes, e.g. for the folders of the state, the recordings, the database spool and the database
    files. A folder of the Detector outside all mounts gets a volume that is removed with the pod."""
    secret_names: list[SubdomainName] = Field(default_factory=list, max_length=32, json_schema_extra=SET_LIST)
    """The Secrets that rules may use. A Secret that the Detector itself refers to is available to rules only if it is
    listed here as well. Anyone who can write rules can send the contents of these Secrets elsewhere."""

    @model_validator(mode="after")
    def _mounts_volumes(self) -> DetectorPod:
        volumes = {each.name for each in self.volumes}
        for mount in self.volume_mounts:
            if mount.name not in volumes:
                raise ValueError(
                    f"volumeMounts: {mount.mount_path}: there is no volume {mount.name}: add it to volumes"
                )
        return self

    @property
    def on_its_own(self) -> list[str]:
        """The given fields that are valid only for the detector's own pod."""
        given = {name: getattr(self, to_snake(name)) for name in OF_ITS_OWN_POD}
        return [name for name, value in given.items() if value]


OF_ITS_OWN_POD = (
    "nodeSelector", "affinity", "tolerations", "priorityClassName", "runtimeClassName", "securityContext"
)  # fmt: skip
"""The fields of a pod that have no effect on a container in an existing pod."""
