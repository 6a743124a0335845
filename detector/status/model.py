"""The status of a running detector in its transmitted form: JSON with camelCase names.

Counts are since the detector's start, times are seconds, sizes bytes.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any

import msgspec


class Histogram(msgspec.Struct, frozen=True, rename="camel"):
    """Counts of times up to each bound, in seconds; `counts` has one more entry, for longer times."""

    bounds: tuple[float, ...]
    counts: tuple[int, ...]
    sum: float

    @property
    def count(self) -> int:
        """Number of measured times."""
        return sum(self.counts)

    def quantile(self, share: float) -> float | None:
        """Seconds: the bound below which that share of the times lies; infinite beyond the last, None without times."""
        seen, wanted = 0, share * self.count
        for bound, count in zip((*self.bounds, float("inf")), self.counts, strict=True):
            seen += count
            if seen and seen >= wanted:
                return bound
        return None


class Drops(msgspec.Struct, frozen=True, rename="camel"):
    """The losses or unusable data of one cause."""

    cause: str
    what: str
    count: int
    stream: str = ""
    rule: str = ""
    last: str = ""
    """The reason of the last one, if known."""


class StreamStatus(msgspec.Struct, frozen=True, rename="camel"):
    """One stream, over all clients."""

    name: str
    samples: int
    """Taken into the buffer since the start."""
    rate: float
    """Samples a second, over the last ten seconds or so."""
    clients: int
    """Number of clients with samples in the buffer."""
    age: float | None
    """Since the newest sample, on the detector's time axis; None if there is none."""
    buffered_samples: int
    buffered_bytes: int
    latency: Histogram
    """From stamp to receipt, measured once a second on the newest sample of some clients."""


class RuleState(StrEnum):
    """Whether a rule is evaluated."""

    ACCEPTED = "Accepted"
    REFUSED = "Refused"
    DISABLED = "Disabled"
    PAUSED = "Paused"
    DEGRADED = "Degraded"


class RuleStatus(msgspec.Struct, frozen=True, rename="camel"):
    """One rule, over all subjects."""

    name: str
    state: RuleState
    message: str = ""
    """Why it is not Accepted."""
    evaluations: int = 0
    """Number of evaluated subjects."""
    ticks: int = 0
    """Number of ticks at which the rule was evaluated, each for all its subjects."""
    time: float = 0.0
    """Time spent on its evaluation."""
    unknowns: int = 0
    """Values that were absent when an expression needed them."""
    absences: dict[str, int] = {}
    """Missing values, as far as expressions reported them."""
    errors: int = 0
    last_error: str = ""
    started: int = 0
    ended: int = 0
    open: int = 0
    """Number of open episodes."""
    pending: int = 0
    """Subjects whose condition holds, but for less than `for`."""
    latency: Histogram | None = None
    """From the receipt of the newest sample that an evaluation read to the end of the evaluation; clock Wall only."""


class SubjectStatus(msgspec.Struct, frozen=True, rename="camel"):
    """The values of one subject in an evaluation of a rule; None stands for unknown."""

    subject: str
    evaluated: bool
    """Whether the evaluation included the subject."""
    why: str = ""
    """Why it was not evaluated."""
    in_scope: bool | None = None
    near: bool | None = None
    """Whether an episode may start: a pair within reach."""
    when: bool | None = None
    until: bool | None = None
    open: bool = False
    pending: float | None = None
    """How long `when` has held, for a subject that waits for `for`."""
    values: dict[str, Any] = {}
    """The values in the form of an event."""
    unknown: dict[str, str] = {}
    """The signals without a value, and the reasons."""


class RuleExplanation(msgspec.Struct, frozen=True, rename="camel"):
    """The values of one evaluation of a rule."""

    tick: float
    """Its time on the detector's axis, seconds since the epoch."""
    subjects: list[SubjectStatus]
    notes: list[str]
    """Absent values and failures of expressions."""


class ClientStatus(msgspec.Struct, frozen=True, rename="camel"):
    """A known client."""

    name: str
    age: float
    """Since something was last received from it."""


class SourceStatus(msgspec.Struct, frozen=True, rename="camel"):
    """A source other than Zenoh."""

    name: str
    plugin: str
    state: str
    """Running, Pausing (it failed and will be restarted), Finished or Stopped."""
    messages: int
    """Delivered since the start, or since it was last changed."""
    last_error: str = ""


class ActionStatus(msgspec.Struct, frozen=True, rename="camel"):
    """An action of a rule, other than deploy, and the outcomes of its episodes."""

    rule: str
    action: str
    kind: str
    """The kind of action: record, database, trigger, notify, or a plugin."""
    running: int
    done: int
    failed: int
    samples: int
    """Of runs that are done or failed, like missing, bytes and files."""
    missing: int
    """Lost on the way."""
    bytes: int
    files: int
    last_file: str = ""
    last_failure: str = ""
    current: dict[str, str] = {}
    """By running episode, the last message, of at most 20."""


class TaskStatus(msgspec.Struct, frozen=True, rename="camel"):
    """What the deploy actions did to ApplicationTasks, as numbers of tasks."""

    created: int = 0
    recreated: int = 0
    """Recreated because another client deleted them while they were demanded."""
    adopted: int = 0
    """They existed when they were to be created: the response to an earlier request was lost."""
    replaced: int = 0
    """Deleted and recreated because the demand differs in an immutable field."""
    patched: int = 0
    ended: int = 0
    retried: int = 0
    """Attempts that failed because the API server was unavailable or busy."""
    refused: dict[str, int] = {}
    """Attempts that the API server rejected, by its reason."""
    pending: int = 0
    """Tasks that wait for a change."""


TASK_CHANGES = ("created", "recreated", "adopted", "replaced", "patched", "ended")
"""The counts of `TaskStatus` that are changes."""


class LeaseStatus(msgspec.Struct, frozen=True, rename="camel"):
    """The Lease of the holder; only in a cluster."""

    held: bool
    """Whether this process may emit tasks."""
    attempts: int
    """Number of attempts to acquire or renew it."""
    failures: int
    """Number of failed attempts."""


class CertificateStatus(msgspec.Struct, frozen=True, rename="camel"):
    """The certificate of the detector on Zenoh."""

    expires: float | None = None
    """When the first certificate of its own chain expires, seconds since the epoch; None: it has none."""
    renewals: int = 0
    """Number of renewals of certificates or passwords."""
    problem: str = ""
    """Why the current contents of the files are not used."""


class Status(msgspec.Struct, frozen=True, rename="camel"):
    """The status of a detector."""

    detector: str
    holder: str
    namespace: str
    version: str
    generation: int
    """The generation of the Detector in use; 0 if it comes from a file."""
    clock: str
    started: float
    """Seconds since the epoch."""
    taken: float
    """The time of this status; seconds since the epoch."""
    now: float
    """All ticks up to this time have run, on the detector's time axis; seconds since the epoch."""
    gaps: int
    buffered_bytes: int
    maximum_bytes: int
    client_count: int
    clients: list[ClientStatus]
    """At most 200, by name."""
    streams: list[StreamStatus]
    rules: list[RuleStatus]
    drops: list[Drops]
    explanation: RuleExplanation | None = None
    """Of the requested rule, if it was evaluated in the meantime."""
    connected: bool = False
    """Whether a router, a peer or a client is connected."""
    sources: list[SourceStatus] = []
    actions: list[ActionStatus] = []
    certificate: CertificateStatus = CertificateStatus()
    demands: list[str] = []
    """The names of the currently demanded tasks; at most 200."""
    demand_count: int = 0
    tasks: TaskStatus = TaskStatus()
    lease: LeaseStatus | None = None
    """None if tasks go into files."""
    missing: list[str] = []
    """Expected clients without a token that have sent nothing for `clientTimeout`; at most 200, by name."""
    missing_count: int = 0


def to_json(value: msgspec.Struct) -> bytes:
    """The value as JSON, UTF-8; NaN and infinities as null."""
    return msgspec.json.encode(value)


def read_status(payload: bytes) -> Status:
    """The status from the output of `to_json`; fields of later versions are ignored. Raises ValueError."""
    return msgspec.json.decode(payload, type=Status)
