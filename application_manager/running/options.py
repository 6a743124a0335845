"""The options of a manager."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import zenoh

from application_manager.admission.webhook import WebhookOptions
from application_manager.charts.chartcache import default_folder
from application_manager.charts.helm import HelmRunner
from application_manager.cluster.leadership import LeaseKey
from application_manager.core.holders.policies import TaskPolicy
from application_manager.core.objects.poddefaults import PodDefaults
from application_manager.core.objects.policy import Policy
from application_manager.observability.pages import STALLED_AFTER
from application_manager.workers.pool import CPU_TIME


@dataclass(frozen=True, slots=True)
class Options:
    """The options of the command line, which documents them; None: not given, or no limit.

    Attributes:
        namespaces: empty: all.
        resync, ttl_after_finished, stalled_after, watch_timeout, cpu_time: seconds.
        memory_limit: bytes.
        lease: of leader election.
        detectors: the defaults for the pods of detectors; None: run no detectors.
    """

    policy: Policy = field(default_factory=Policy)
    namespaces: tuple[str, ...] = ()
    max_instances: int | None = None
    tasks: TaskPolicy = field(default_factory=TaskPolicy)
    resync: float = 60.0
    ttl_after_finished: float = 3600.0
    metrics_port: int | None = None
    metrics_certificates: Path | None = None
    zenoh: zenoh.Config | None = None
    helm: HelmRunner = field(default_factory=HelmRunner)
    chart_cache: Path = field(default_factory=default_folder)
    chart_folder: Path = Path("/charts")
    admission: WebhookOptions | None = None
    lease: LeaseKey = field(default_factory=lambda: LeaseKey("default"))
    stalled_after: float = STALLED_AFTER
    watch_timeout: float = 90.0  # the API server sends a bookmark per watch and minute
    detectors: PodDefaults | None = None
    memory_limit: int | None = None
    cpu_time: float = CPU_TIME
