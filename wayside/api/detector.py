"""Detector: the data that a detector receives, how long it is kept, and the rules to evaluate."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, ClassVar

from pydantic import Field, model_validator

from wayside.api.access import FilePath
from wayside.api.base import (
    ATOMIC_LIST,
    SET_LIST,
    ClientName,
    Conditions,
    Count,
    Duration,
    Kind,
    Model,
    ObjectName,
    PositiveDuration,
    PositiveQuantity,
    SubdomainName,
    map_list,
)
from wayside.api.constraints import GIVEN_TWICE, constraint, unique
from wayside.api.database import DatabaseConnection
from wayside.api.freedata import Constants
from wayside.api.place import MapFile, Place
from wayside.api.plugin import DataSource
from wayside.api.pod import OF_ITS_OWN_POD, DetectorMode, DetectorPod
from wayside.api.recordings import Recordings
from wayside.api.selector import LabelSelector
from wayside.api.stream import (
    Asn1Module,
    MessageDefinition,
    Stream,
)
from wayside.api.zenoh import Zenoh

STALE_AFTER = PositiveDuration("5s")
"""The default of a stream's `staleAfter`. A stream with one sample per second, such as slow CAMs, can lose a few
samples."""


class KnownClient(Model):
    """A client that is known in advance."""

    name: ClientName
    """The name of the client, as in the keys of the streams."""
    labels: dict[Annotated[str, Field(max_length=63)], Annotated[str, Field(max_length=256)]] = Field(
        default_factory=dict, max_length=32
    )
    """Labels that rules can use, e.g. labels.role."""
    parameters: dict[ObjectName, Constants] = Field(default_factory=dict, max_length=64)
    """Values that replace a rule's parameters for this client, by rule name and parameter name. In a pairs scope,
    expressions read them as a.parameters or b.parameters."""
    expected: bool = False
    """If true, the client is known from the start of the detector, even without data, and is never lost. A rule can
    then detect that, for example, a roadside station is silent."""


class BufferLimits(Model):
    """The limits of the buffer of all streams."""

    duration: PositiveDuration = PositiveDuration("10s")
    """How long samples are kept. A stream can set its own duration."""
    bytes: PositiveQuantity = PositiveQuantity("512Mi")
    """The maximum size of all streams together. At the limit, the oldest samples are dropped."""


class Clock(StrEnum):
    """The time axis of the detector."""

    WALL = "Wall"
    DATA = "Data"


class State(Model):
    """The storage of open episodes, so that a restart does not lose them."""

    path: FilePath
    """The folder, on a volume that outlives the process, e.g. /var/lib/wayside. It is created if missing. A change
    takes effect at the next start."""


_ITS_OWN_POD = " || ".join(f"has(self.pod.{field})" for field in OF_ITS_OWN_POD)


class DetectorSpec(Model):
    """Streams, buffer, time and rules of a detector."""

    constraints = (
        unique("streams", "sources", "clients", "places", "messages"),
        constraint(
            "has(self.mode) || !has(self.pod)",
            "pod has no effect without mode: set mode to Standalone or Sidecar, or remove pod",
            ".pod",
            "Forbidden",
            holds=lambda detector: detector.mode is not None or detector.pod is None,
        ),
        constraint(
            "!has(self.serviceAccountNames) || (has(self.mode) && self.mode == 'Sidecar')",
            "serviceAccountNames has no effect without mode Sidecar: set mode: Sidecar, or remove it",
            ".serviceAccountNames",
            "Forbidden",
            holds=lambda detector: detector.service_account_names is None or detector.mode is DetectorMode.SIDECAR,
        ),
        constraint(
            f"!has(self.mode) || self.mode != 'Sidecar' || !has(self.pod) || !({_ITS_OWN_POD})",
            f"{', '.join(f'pod.{field}' for field in OF_ITS_OWN_POD)} have no effect with mode Sidecar, which uses an "
            "existing pod: remove them",
            ".pod",
            "Forbidden",
        ),
        unique("service_account_names", wording=GIVEN_TWICE),
    )

    mode: DetectorMode | None = None
    """Standalone: the application manager runs the detector as a Deployment in this namespace. Sidecar: the application
    manager injects the detector into the pods of this namespace that have the label wayside.dev/detector: <name>.
    Default: the detector is run by other means."""
    pod: DetectorPod | None = None
    """The detector's pod (Standalone), or its container in other pods (Sidecar). Only with a mode."""
    service_account_names: list[SubdomainName] | None = Field(default=None, max_length=64, json_schema_extra=SET_LIST)
    """The service accounts whose pods may run the detector. Only these accounts get the detector's permissions. Only
    with mode Sidecar."""
    zenoh: Zenoh = Zenoh()
    """The Zenoh session."""
    sources: list[DataSource] = Field(default_factory=list, max_length=16, json_schema_extra=map_list("name"))
    """Sources of streams other than Zenoh."""
    clients: list[KnownClient] = Field(default_factory=list, max_length=1024, json_schema_extra=map_list("name"))
    """Clients that are known in advance. Other clients appear with their first sample."""
    streams: list[Stream] = Field(min_length=1, max_length=128, json_schema_extra=map_list("name"))
    """The data that the detector receives."""
    asn1: list[Asn1Module] = Field(default_factory=list, max_length=32, json_schema_extra=ATOMIC_LIST)
    """ASN.1 modules for uper streams. They define messages that no package defines, such as etsi/cpm, or replace the
    definitions of the packages. Include all modules that they import."""
    messages: list[MessageDefinition] = Field(default_factory=list, max_length=256, json_schema_extra=map_list("name"))
    """Definitions of ROS 2 message types that are not in the common packages, or differ from them."""
    places: list[Place] = Field(default_factory=list, max_length=512, json_schema_extra=map_list("name"))
    """The areas, lines and lanes that rules can name, as in at(position, "crossing")."""
    maps: list[MapFile] = Field(default_factory=list, max_length=16, json_schema_extra=ATOMIC_LIST)
    """Files with more places. Lanelet2 maps and the field origin need pip install 'wayside[maps]'."""
    buffer: BufferLimits = BufferLimits()
    """The limits of the buffer of samples."""
    client_timeout: PositiveDuration = PositiveDuration("30s")
    """A client is lost after this time without data, and its episodes end with reason ClientLost. Time before the start
    of the detector does not count."""
    clock: Clock = Clock.WALL
    """The time of a sample. Wall: the time at which it was received. Data: its stamp, for simulated time and
    recordings."""
    lateness: Duration = Duration("200ms")
    """Only with clock Data: how late samples may arrive. Tick t runs when the detector has received a stamp that is
    later than t and not earlier than t + lateness."""
    max_ahead: Duration = Duration("1s")
    """Only with clock Data: how far a stamp may be ahead of all others. A sample that is further ahead is dropped and
    counted."""
    state: State | None = None
    """Persists open episodes. Without it, a restart restores only those episodes that have a live task."""
    recordings: Recordings | None = None
    """The storage of record actions. Required by rules that record."""
    database: DatabaseConnection | None = None
    """The MongoDB database of database actions. Required by rules that use them."""
    rule_selector: LabelSelector = LabelSelector()
    """Selects the EventRules of the namespace to evaluate, by their labels. Default: every rule."""

    @model_validator(mode="after")
    def _in_a_pod(self) -> DetectorSpec:
        if self.mode is None:
            return self
        if self.mode is DetectorMode.SIDECAR and self.pod is not None and (given := self.pod.on_its_own):
            fields = " and ".join(f"pod.{field}" for field in given)
            raise ValueError(f"mode Sidecar uses an existing pod: remove {fields}")
        for field, path in self.folders.items():
            if not path.startswith("/") or path.strip("/") == "" or ":" in path or ".." in path.split("/"):
                raise ValueError(
                    f"{field}: must be an absolute path without .. and :, such as /var/lib/wayside, if the detector "
                    f"runs in a pod; got {path!r}"
                )
        return self

    @property
    def folders(self) -> dict[str, str]:
        """The folders that the detector writes to, by their fields."""
        database = self.database
        spool, files = (None, None) if database is None else (database.spool, database.files)
        given = {
            "state.path": self.state,
            "recordings.path": self.recordings,
            "database.spool.path": spool,
            "database.files.path": files,
        }
        return {field: each.path for field, each in given.items() if each is not None}

    @model_validator(mode="after")
    def _streams_on_request(self) -> DetectorSpec:
        allowed = None if self.recordings is None else self.recordings.on_request
        for name in (allowed.streams or ()) if allowed is not None else ():
            if self.stream(name) is None:
                there = ", ".join(stream.name for stream in self.streams)
                raise ValueError(f"recordings.onRequest.streams: the Detector has no stream {name}; it has {there}")
        return self

    def stream(self, name: str) -> Stream | None:
        """The stream of that name, if there is one."""
        return next((stream for stream in self.streams if stream.name == name), None)

    def buffer_duration_ns(self, stream: Stream) -> int:
        """How long samples of the stream are kept, in nanoseconds."""
        return (stream.buffer.duration or self.buffer.duration).ns

    def stale_after_ns(self, stream: Stream) -> int | None:
        """The age at which a stream's newest sample is stale, in nanoseconds; None: never."""
        if stream.never_stale:
            return None
        if stream.stale_after_ns is not None:
            return stream.stale_after_ns
        return min(STALE_AFTER.ns, self.client_timeout.ns)


class DetectorStatus(Model):
    """The observed state of the detector."""

    observed_generation: Count = 0
    """The metadata.generation that the status was computed from."""
    rules: Count = 0
    """The number of EventRules that the detector selects."""
    conditions: Conditions = Field(default_factory=list)
    """Accepted: the specification is valid. Running (only with a mode): the detector runs; otherwise the reason
    explains why not. Ready: Accepted and, with a mode, Running are True. Stalled: the specification is invalid and must
    be corrected."""


class Detector(Kind):
    """The configuration of a detector: the data that it receives, buffers and evaluates."""

    plural: ClassVar[str] = "detectors"
    short_name: ClassVar[str] = "det"
    printer_columns: ClassVar[list[dict[str, Any]]] = [
        {"name": "Clock", "type": "string", "jsonPath": ".spec.clock"},
        {"name": "Rules", "type": "integer", "jsonPath": ".status.rules"},
        {"name": "Ready", "type": "string", "jsonPath": '.status.conditions[?(@.type=="Ready")].status'},
        {
            "name": "Running",
            "type": "string",
            "jsonPath": '.status.conditions[?(@.type=="Running")].status',
            "priority": 1,
        },
        {"name": "Age", "type": "date", "jsonPath": ".metadata.creationTimestamp"},
        {"name": "Message", "type": "string", "jsonPath": '.status.conditions[?(@.status=="False")].message'},
    ]

    kind: str = "Detector"
    spec: DetectorSpec
    """The streams, buffer, clock and rules of the detector."""
    status: DetectorStatus | None = None
    """The observed state of the detector."""
