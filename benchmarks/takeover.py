"""The active manager is killed → its standby serves a new task, compared with the same task under an active manager.

Each round starts two managers. A task is created and the time until its Deployment exists is taken; then the active
manager is killed with SIGKILL (or stopped with SIGSTOP, in turns), a task is created at once, and the time is taken
again: until the standby has waited for the Lease, has listed afresh and has acted. Exits with 1 where a takeover took
longer than the target.

    python -m benchmarks.takeover [--rounds 6]
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import sys
import tempfile
import time
from pathlib import Path

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api, ApiError
from tests.cluster.controlplane import ControlPlane
from tests.cluster.crds import CRDS
from tests.cluster.expected_objects import start_manager, task, template
from tests.cluster.namespaces import fresh_namespace
from tests.cluster.processes import Processes

TARGET = 15.0
"""Seconds."""

PATIENCE, PAUSE = 120.0, 0.02


def served(api: Api, region: str) -> float:
    """Seconds from the creation of a task until its Deployment exists."""
    began = time.monotonic()
    api.create(task(region))
    while time.monotonic() - began < PATIENCE:
        try:
            api.get("Deployment", instance_name("app", region))
        except ApiError as error:
            if error.code != 404:
                raise
            time.sleep(PAUSE)
        else:
            return time.monotonic() - began
    sys.exit(f"no Deployment for {region} within {PATIENCE:g} s")


def play(plane: ControlPlane, number: int, how: signal.Signals) -> tuple[float, float]:
    """One round; seconds with an active manager, and once it was gone."""
    with fresh_namespace(plane.api(), f"takeover-{number}") as namespace, tempfile.TemporaryDirectory() as logs:
        api = plane.api(namespace)
        processes = Processes(Path(logs), {"KUBECONFIG": str(plane.kubeconfig)})
        try:
            active = start_manager(processes, namespace)
            active.wait_for_output("active: holds the Lease")
            standby = start_manager(processes, namespace)
            standby.wait_for_output("standby: manager_")
            api.create(template())
            served(api, "warm")
            plain = served(api, "before")
            os.kill(active.pid, how)
            return plain, served(api, "after")
        finally:
            processes.kill_all()


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=6)
    options = parser.parse_args()
    plain, taken = [], []
    with ControlPlane(crds=CRDS) as plane:
        for number in range(options.rounds):
            how = (signal.SIGKILL, signal.SIGSTOP)[number % 2]
            before, after = play(plane, number, how)
            print(f"{how.name}: with an active manager {before:.2f} s, taken over {after:.2f} s", flush=True)
            plain.append(before)
            taken.append(after)
    worst = max(taken)
    verdict = "met" if worst <= TARGET else "missed"
    middle = statistics.median(taken)
    print(f"taken over: median {middle:.1f} s, worst {worst:.1f} s (target: at most {TARGET:g} s, {verdict})")
    print(f"ratio of the medians to an active manager's {middle / statistics.median(plain):.0f}")
    sys.exit(0 if worst <= TARGET else 1)


if __name__ == "__main__":
    main()
