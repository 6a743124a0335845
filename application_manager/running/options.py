"""The options of a manager."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import zenoh

from application_manager.admission.reviewing import Serving
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
    """The options of the command line.

    Attributes:
        policy: what templates may create.
        namespaces: those to look at; empty: all.
        max_instances: how many instances a namespace may have; None: any number.
        tasks: what limits tasks.
        resync: seconds between two full resyncs.
        ttl_after_finished: seconds that finished tasks are kept.
        metrics_port: where metrics and health are served; None: nowhere.
        metrics_certificates: the folder with the certificate by which they are served; None: without TLS.
        zenoh: where configurations are published; None: nowhere.
        helm: renders charts.
        chart_cache: the folder in which fetched charts are kept.
        chart_folder: the folder with the charts of the image.
        admission: where the API server's questions about objects are answered; None: nowhere.
        lease: by which one of several managers is active.
        stalled_after: seconds after which the watchdog ends a manager whose work has stalled.
        watch_timeout: seconds without an event or a bookmark after which a watch is restarted.
        detectors: what holds for the pods of detectors; None: no detector is run.
        memory_limit: bytes that the manager and its worker processes may have together; None: any number.
        cpu_time: seconds of CPU time that one evaluation of a template's or rule's expressions may take.
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
    admission: Serving | None = None
    lease: LeaseKey = field(default_factory=lambda: LeaseKey("default"))
    stalled_after: float = STALLED_AFTER
    watch_timeout: float = 90.0
    detectors: PodDefaults | None = None
    memory_limit: int | None = None
    cpu_time: float = CPU_TIME
