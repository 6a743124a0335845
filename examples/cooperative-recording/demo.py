"""The whole chain without a cluster: vehicles, events, tasks, and the applications that would run.

Three parts that know nothing of each other: fifteen vehicles (drive.py), a detector (`detector run`), and here the
core of the application manager, which looks at the tasks that the detector leaves in a folder. The vehicles' data and
the events go over Zenoh. The published events are also compared with those computed from the vehicles' positions.
"""

from __future__ import annotations

import argparse
import json
import queue
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import zenoh
from cooperative_recording.seeds import DEMO_SEED
from cooperative_recording.vehicles import simulate
from foresight import Foresight, TaskFolder
from rich.console import Console

from wayside.api import ApplicationTask, ApplicationTemplate
from wayside.api.documents import load_documents
from wayside.manifests import to_yaml

HERE = Path(__file__).resolve().parent
ENDPOINT = "tcp/127.0.0.1:7447"
"""The endpoint at which the detector of detector.yaml listens."""
INTAKE = "intake.mcap"
"""The recorded intake of the detector, for the report."""
WRITTEN = ("events.jsonl", "tasks.yaml", "manifests.yaml", "detector.log", INTAKE, "report.html")
"""The output files, in addition to the folder tasks."""
DURATION_S = 22.5
"""Of the drive: by then all have parted, and the demo is no longer than it must be."""
PATIENCE_S = 60.0
"""How long to wait, on a slow machine, for a start, for the last applications after the drive, and for an end."""
LOOK_S = 1.0
"""How long one attempt to reach the detector takes at most; then it is seen whether it still runs."""


def main() -> int:
    """Run the demo; 1 means that the detected episodes differ from those computed from the positions."""
    parser = argparse.ArgumentParser(prog="demo.py", description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("out"), help="the folder for what comes out (%(default)s)")
    output: Path = parser.parse_args().output
    output.mkdir(parents=True, exist_ok=True)
    for file in [*(output / name for name in WRITTEN), *(output / "tasks").glob("*.yaml")]:
        file.unlink(missing_ok=True)
    console = Console(highlight=False, soft_wrap=True)
    console.print(
        "[bold]Fifteen vehicles drive, and six of them carry a lidar. "
        "If two of the six are closer than 150 m, record the scene.[/]"
    )
    with _detector(output) as detector, _vehicles() as drive:
        expected = _expected()  # while both are starting
        with _events(detector) as events:
            teller = Timeline(console, output / "tasks")
            until = None
            while until is None or (teller.running and time.monotonic() < until):
                teller.look(events)
                if detector.poll() is not None:
                    console.print(f"[red]the detector ended early:[/] see {output / 'detector.log'}")
                    return 1
                if until is None and drive.poll() is not None:
                    until = time.monotonic() + PATIENCE_S
        drove = drive.wait() == 0
    teller.write_manifests(output / "manifests.yaml")
    if (ended := _report(output)) != 0:
        console.print(f"[red]the replay for the report ended with {ended}:[/] see {output / 'detector.log'}")
        return 1
    return _verdict(console, output, expected, teller.running, drove=drove)


def _expected() -> list[str]:
    """The subjects of the episodes that the positions alone give."""
    from cooperative_recording.expected import episodes  # noqa: PLC0415  takes a second, which the others have started in

    return sorted("+".join(each.pair) for each in episodes(simulate(DEMO_SEED, DURATION_S), DURATION_S))


@contextmanager
def _vehicles() -> Iterator[subprocess.Popen[bytes]]:
    """The drive; it begins as soon as the detector listens."""
    command = ["--connect", ENDPOINT, "--seed", str(DEMO_SEED), "--duration", str(DURATION_S)]
    command += ["--wait", str(PATIENCE_S)]
    process = subprocess.Popen([sys.executable, str(HERE / "drive.py"), *command], stdout=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


@contextmanager
def _detector(output: Path) -> Iterator[subprocess.Popen[bytes]]:
    """`detector run` on the example's files; ended in good order."""
    command = ["-m", "detector.commands.cli", "run", "--detector", "detector.yaml", "--rules", "rules.yaml"]
    command += ["--record-intake", str(output.resolve() / INTAKE)]
    with (output / "detector.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, *command, "--output", str(output.resolve())], cwd=HERE, stderr=log, stdout=log
        )
        try:
            yield process
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(PATIENCE_S)


def _report(output: Path) -> int:
    """Replay what the detector took in, for a report. The replay gives the same events and tasks."""
    command = ["-m", "detector.commands.cli", "replay", INTAKE, "--output", ".", "--results", "report"]
    with (output / "detector.log").open("ab") as log:
        return subprocess.run([sys.executable, *command], cwd=output, stderr=log, stdout=log, check=False).returncode


@contextmanager
def _events(detector: subprocess.Popen[bytes]) -> Iterator[queue.Queue[dict[str, Any]]]:
    """The CloudEvents that the detector publishes, as anybody on the network gets them; none if it ends before."""
    events: queue.Queue[dict[str, Any]] = queue.Queue(1000)
    config = zenoh.Config()
    for key, value in {
        "connect/endpoints": [ENDPOINT],
        "connect/timeout_ms": round(LOOK_S * 1000),
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 200, "period_increase_factor": 1},
        "listen/endpoints": [],
        "scouting/multicast/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    session = _session(config, detector)
    if session is None:
        yield events
        return
    with session:
        session.declare_subscriber(
            "wayside/events/**", lambda sample: events.put(json.loads(sample.payload.to_bytes()))
        )
        yield events


def _session(config: zenoh.Config, detector: subprocess.Popen[bytes]) -> zenoh.Session | None:
    """A session with the detector, which is just starting; None if it ends instead."""
    patience = time.monotonic() + PATIENCE_S
    while detector.poll() is None:
        try:
            return zenoh.open(config)
        except zenoh.ZError:
            if time.monotonic() >= patience:
                raise
    return None


class Timeline:
    """Lines about published events and demanded instances, in order."""

    def __init__(self, console: Console, folder: Path) -> None:
        self._console = console
        self._folder = TaskFolder(folder)
        self._tasks: set[str] = set()
        self._ended: set[str] = set()
        templates = [document.object for document in load_documents([HERE / "templates.yaml"])]
        self._foresight = Foresight([each for each in templates if isinstance(each, ApplicationTemplate)])
        self._begin = time.monotonic()

    def look(self, events: queue.Queue[dict[str, Any]]) -> None:
        """Wait a moment for an event, then print what is new."""
        with suppress(queue.Empty):
            self._event(events.get(timeout=0.1))
            while True:
                self._event(events.get_nowait())
        tasks = self._folder.tasks()
        for name, task in sorted(tasks.items()):
            if name not in self._tasks:
                self._tasks.add(name)
                self._line("task", "cyan", f"for {_subject(task)}: {task.spec.template_name} ({name})")
            if task.spec.end_time is not None and name not in self._ended:
                self._ended.add(name)
                self._line("task", "cyan", f"for {_subject(task)}: {task.spec.template_name} has ended")
        for change in self._foresight.look(tasks, time.time()):
            detail = f": {change.detail}" if change.detail else ""
            self._line("instance", "green", f"{change.instance} [bold]{change.what}[/]{detail}")

    def write_manifests(self, path: Path) -> None:
        """The manifests of every instance that there was, as they were last."""
        manifests = [each for rendering in self._foresight.ever.values() for each in rendering.manifests]
        path.write_text(to_yaml(manifests), encoding="utf-8")

    @property
    def running(self) -> list[str]:
        """The instances that would still exist."""
        return sorted(self._foresight.instances)

    def _event(self, event: dict[str, Any]) -> None:
        data = event["data"]
        who = " and ".join(data["subjects"])
        distance = data["values"].get("distance")
        at = "" if distance is None else f" at {distance:.0f} m"
        if event["type"].endswith("started"):
            self._line("event", "yellow", f"{who} came close{at}: episode {data['episode']} starts")
        else:
            self._line("event", "yellow", f"{who} parted{at}: episode {data['episode']} ends ({data['reason']})")

    def _line(self, kind: str, colour: str, text: str) -> None:
        self._console.print(f"{time.monotonic() - self._begin:5.1f} s  [{colour}]{kind:8}[/]  {text}")


def _subject(task: ApplicationTask) -> str:
    return task.spec.event.subject if task.spec.event else "nobody"


def _verdict(console: Console, output: Path, expected: list[str], running: list[str], *, drove: bool) -> int:
    """Compare the episodes with those expected."""
    lines = (output / "events.jsonl").read_text(encoding="utf-8").splitlines()
    found = sorted(event["subject"] for event in map(json.loads, lines) if event["type"].endswith("started"))
    console.print(
        f"[bold]{len(found)} episodes detected; {len(expected)} expected from the vehicles' positions."
        f" Applications still running: {len(running)}.[/]"
    )
    console.print(f"See {output}/events.jsonl, {output}/tasks.yaml, {output}/manifests.yaml (and detector.log).")
    console.print(f"Open {output}/report.html in a browser to see what happened, and why.")
    if found != expected or running or not drove:
        console.print(f"[red]Not as expected:[/] detected {found}, expected {expected}, still running {running}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
