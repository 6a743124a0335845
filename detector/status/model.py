"""The status of a running detector, as it travels: JSON with camelCase names.

Counts are since the detector's start, times are seconds, sizes bytes.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any

import msgspec


class Histogram(msgspec.Struct, frozen=True, rename="camel"):
    """How often a time in seconds was at most each bound; `counts` has one more, for what was longer."""

    bounds: tuple[float, ...]
    counts: tuple[int, ...]
    sum: float

    @property
    def count(self) -> int:
        """How many times were measured."""
        return sum(self.counts)

    def quantile(self, share: float) -> float | None:
        """Seconds: the bound below which that share of the times lies; infinite beyond the last, None without any."""
        seen, wanted = 0, share * self.count
        for bound, count in zip((*self.bounds, float("inf")), self.counts, strict=True):
            seen += count
            if seen and seen >= wanted:
                return bound
        return None


class Drops(msgspec.Struct, frozen=True, rename="camel"):
    """What was lost for one cause, or could not be used."""

    cause: str
    what: str
    count: int
    stream: str = ""
    rule: str = ""
    last: str = ""
    """The reason of the last one, where there is one."""


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
    """Since the newest sample, on the detector's time axis; None where none is there."""
    buffered_samples: int
    buffered_bytes: int
    latency: Histogram
    """From stamp to receipt, of the newest sample of some clients, looked at once a second."""


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
    """Subjects looked at."""
    ticks: int = 0
    """Times at which the rule was evaluated, for all its subjects."""
    time: float = 0.0
    """Spent on evaluating it."""
    unknowns: int = 0
    """Values that were not there when an expression needed them."""
    absences: dict[str, int] = {}
    """What was missing, as far as expressions reported it."""
    errors: int = 0
    last_error: str = ""
    started: int = 0
    ended: int = 0
    open: int = 0
    """Episodes that are open now."""
    pending: int = 0
    """Subjects whose condition holds, but not yet for as long as `for`."""
    latency: Histogram | None = None
    """From the receipt of the newest sample that an evaluation saw to the evaluation's end; clock Wall only."""


class SubjectStatus(msgspec.Struct, frozen=True, rename="camel"):
    """What one evaluation of a rule saw of a subject; None stands for unknown."""

    subject: str
    looked_at: bool
    why: str = ""
    """Why it was not looked at."""
    in_scope: bool | None = None
    near: bool | None = None
    """Whether an episode may start: a pair within reach."""
    when: bool | None = None
    until: bool | None = None
    open: bool = False
    pending: float | None = None
    """For how long `when` has held, of a subject that waits for `for`."""
    values: dict[str, Any] = {}
    """As an event would have them."""
    unknown: dict[str, str] = {}
    """The signals without a value, and why."""


class RuleExplanation(msgspec.Struct, frozen=True, rename="camel"):
    """What one evaluation of a rule saw."""

    tick: float
    """Its time on the detector's axis, seconds since the epoch."""
    subjects: list[SubjectStatus]
    notes: list[str]
    """What expressions missed, or failed on."""


class ClientStatus(msgspec.Struct, frozen=True, rename="camel"):
    """A client that is known."""

    name: str
    age: float
    """Since something was last received from it."""


class SourceStatus(msgspec.Struct, frozen=True, rename="camel"):
    """A source beside Zenoh."""

    name: str
    plugin: str
    state: str
    """Running, Pausing (it failed and is run again), Finished or Stopped."""
    messages: int
    """Delivered since the start, or since it was last changed."""
    last_error: str = ""


class ActionStatus(msgspec.Struct, frozen=True, rename="camel"):
    """An action of a rule, other than deploy: what became of its work for episodes."""

    rule: str
    action: str
    kind: str
    """What acts: record, database, trigger, notify, or a plugin."""
    running: int
    done: int
    failed: int
    samples: int
    """Of runs that are done or failed, as are missing, bytes and files."""
    missing: int
    """Lost on the way."""
    bytes: int
    files: int
    last_file: str = ""
    last_failure: str = ""
    current: dict[str, str] = {}
    """By running episode, the last message, of at most 20."""


class CertificateStatus(msgspec.Struct, frozen=True, rename="camel"):
    """The certificate of the detector on Zenoh."""

    expires: float | None = None
    """When the first certificate of its own chain expires, seconds since the epoch; None: it has none."""
    renewals: int = 0
    """Number of renewals of certificates or passwords."""
    problem: str = ""
    """Why what the files hold now is not used."""


class Status(msgspec.Struct, frozen=True, rename="camel"):
    """The status of a detector."""

    detector: str
    holder: str
    namespace: str
    version: str
    generation: int
    """Of the Detector as it is followed; 0 where it comes from a file."""
    clock: str
    started: float
    """Seconds since the epoch."""
    taken: float
    """When this status was taken; seconds since the epoch."""
    now: float
    """Up to here all ticks have run, on the detector's time axis; seconds since the epoch."""
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
    """The names of the tasks that are demanded now; at most 200."""
    demand_count: int = 0
    missing: list[str] = []
    """Expected clients without a token from which nothing has come for `clientTimeout`; at most 200, by name."""
    missing_count: int = 0


def to_json(value: msgspec.Struct) -> bytes:
    """The value as JSON, UTF-8; what is not finite as null."""
    return msgspec.json.encode(value)


def read_status(payload: bytes) -> Status:
    """What `to_json` made of a status; fields of later versions are left out. Raises ValueError."""
    return msgspec.json.decode(payload, type=Status)
