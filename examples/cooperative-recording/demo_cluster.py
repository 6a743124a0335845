"""The whole chain against a real API server: vehicles, both programs, and the resulting Deployments.

By default a control plane of its own is started (and built first, where it is missing); with `--current` the cluster of
the current kubeconfig is used, in a namespace that is made for the demo and deleted afterwards. On a control plane
without nodes no pod runs, so the applications are applied but never ready.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(ROOT))

from tests.cluster.api import Api  # noqa: E402  the tests' client is made for looking
from tests.cluster.binaries import ensure_binaries  # noqa: E402
from tests.cluster.controlplane import ControlPlane  # noqa: E402
from tests.cluster.crds import CRDS, apply_crds  # noqa: E402

NAMESPACE = "wayside-demo"
PATIENCE_S = 60.0
"""How long to wait, on a slow machine, for a start, for the last applications after the drive, and for an end."""


def main() -> int:
    """Run the demo; 1 means that applications were left over."""
    parser = argparse.ArgumentParser(prog="demo_cluster.py", description=__doc__)
    parser.add_argument("--current", action="store_true", help="use the cluster of the current kubeconfig")
    parser.add_argument("--output", type=Path, default=Path("out"), help="the folder for what comes out (%(default)s)")
    options = parser.parse_args()
    output: Path = options.output.resolve()
    output.mkdir(parents=True, exist_ok=True)
    (output / "events.jsonl").unlink(missing_ok=True)  # the detector would append to it
    console = Console(highlight=False, soft_wrap=True)
    with ExitStack() as stack:
        kubeconfig = _current() if options.current else stack.enter_context(_own_control_plane(console))
        stack.enter_context(_example(Api(kubeconfig)))
        environment = os.environ | {"KUBECONFIG": str(kubeconfig)}
        run = ["run", "--namespace", NAMESPACE]
        stack.enter_context(_program("application_manager.commands.cli", run, output / "manager.log", environment))
        reported = ["--name", "town", "--output", str(output)]
        stack.enter_context(_program("detector.commands.cli", [*run, *reported], output / "detector.log", environment))
        console.print(f"To look on from another terminal: export KUBECONFIG={kubeconfig}")
        console.print(f"                                  kubectl -n {NAMESPACE} get wayside,deployments")
        drive = subprocess.Popen(
            [sys.executable, str(HERE / "drive.py"), "--wait", str(PATIENCE_S)], stdout=subprocess.DEVNULL
        )
        stack.callback(drive.terminate)
        left = _report(console, Api(kubeconfig, NAMESPACE), drive)
    console.print(f"See {output}: events.jsonl, detector.log, manager.log.")
    return 1 if left or drive.returncode else 0


@contextmanager
def _own_control_plane(console: Console) -> Iterator[Path]:
    binaries = ensure_binaries()
    console.print("starting etcd, kube-apiserver and kube-controller-manager")
    with ControlPlane(binaries, CRDS) as plane:
        yield plane.kubeconfig


def _current() -> Path:
    """The kubeconfig of the environment; its cluster gets our CRDs."""
    kubeconfig = Path(os.environ.get("KUBECONFIG", "~/.kube/config")).expanduser()
    if not kubeconfig.is_file():
        raise SystemExit(f"demo_cluster.py: there is no {kubeconfig}: set KUBECONFIG, or leave --current away")
    apply_crds(Api(kubeconfig))
    return kubeconfig


@contextmanager
def _example(api: Api) -> Iterator[None]:
    """The example's files in a namespace of the demo's own, which is deleted afterwards."""
    api.create({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": NAMESPACE}})
    try:
        for file in ("templates.yaml", "rules.yaml", "detector.yaml"):
            for document in yaml.safe_load_all((HERE / file).read_text(encoding="utf-8")):
                document["metadata"]["namespace"] = NAMESPACE
                api.apply(document)
        yield
    finally:
        api.delete("Namespace", NAMESPACE)


@contextmanager
def _program(module: str, arguments: list[str], log: Path, environment: dict[str, str]) -> Iterator[None]:
    """One of our programs; ended in good order."""
    with log.open("wb") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments], env=environment, stdout=file, stderr=subprocess.STDOUT
        )
        try:
            yield
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(PATIENCE_S)


def _report(console: Console, api: Api, drive: subprocess.Popen[bytes]) -> list[str]:
    """Print what changes until the drive is over and the last application is gone; what is left then."""
    begin, until = time.monotonic(), None
    seen: dict[str, str] = {}
    while until is None or (_running(seen) and time.monotonic() < until):
        states = _states(api)
        for name in sorted(seen.keys() | states.keys()):
            if seen.get(name) != states.get(name):
                console.print(f"{time.monotonic() - begin:5.1f} s  {name}  [bold]{states.get(name, 'gone')}[/]")
        seen = states
        if until is None and drive.poll() is not None:
            until = time.monotonic() + PATIENCE_S
        time.sleep(0.2)
    left = [name for name in _running(seen) if name.startswith("Deployment")]
    console.print(f"[red]left over:[/] {', '.join(left)}" if left else "All applications are gone.")
    return left


def _running(states: dict[str, str]) -> list[str]:
    """All objects except ended tasks."""
    return sorted(name for name, state in states.items() if state != "Finished")


def _states(api: Api) -> dict[str, str]:
    """The existing objects with a short state."""
    states: dict[str, str] = {}
    for task in api.list("ApplicationTask"):
        event = task["spec"]["event"]
        phase = task.get("status", {}).get("phase", "new")
        states[f"task {event['subject']} for {task['spec']['templateName']}, {event['startTime'][11:19]}"] = phase
    for instance in api.list("ApplicationInstance"):
        parameters = " ".join(f"{key}={_text(value)}" for key, value in instance["spec"]["parameters"].items())
        phase = instance.get("status", {}).get("phase", "new")
        states[f"instance {instance['metadata']['name']}"] = f"{phase}[/] {parameters}[bold]"
    for deployment in api.list("Deployment"):
        states[f"Deployment {deployment['metadata']['name']}"] = f"generation {deployment['metadata']['generation']}"
    return states


def _text(value: Any) -> str:
    return "+".join(map(str, value)) if isinstance(value, list) else str(value)


if __name__ == "__main__":
    sys.exit(main())
