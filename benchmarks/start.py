"""The start of each command, beside that of a bare `python -c pass`, and how many modules it loads.

A command that ends by itself is measured from its start to its end; one that serves, to the line by which it reports
that it works: `detector run` that the detector runs, `application-manager run` that it queries the API server (there is
none). Commands and baseline in turn. Exits with 1 where the median CPU time of a `--help` misses its target.

    python -m benchmarks.start [--rounds 5]
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from functools import partial
from pathlib import Path
from typing import NamedTuple

import yaml

from tests.ports import free_endpoint, free_port

EXAMPLE = Path(__file__).parents[1] / "examples" / "cooperative-recording"
TARGET_S = 0.4
PATIENCE = 120.0  # s
BARE = "python -c pass"
RUNS = "runs with 1 rule"
RETRIES = "retrying until the API server responds"
IMPORTED = "import time:"
"""How a line of `python -X importtime` begins, one for each module."""


class Command(NamedTuple):
    """What is started, and the words on stderr that end the measurement; None: the command ends by itself."""

    words: list[str]
    until: str | None = None


class Start(NamedTuple):
    """One start: seconds on the wall, seconds of CPU (user and system) of the process."""

    wall: float
    cpu: float


def main() -> int:
    """Measure and print; 1 means that a target was missed."""
    parser = argparse.ArgumentParser(prog="start", description=__doc__)
    parser.add_argument("--rounds", type=int, default=5, help="of each command (%(default)s)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        commands = _commands(Path(folder))
        starts: dict[str, list[Start]] = {name: [] for name in commands}
        for _ in range(options.rounds):
            for name, command in commands.items():
                starts[name].append(_start(command, Path(folder))[0])
        modules = {name: _modules(command, Path(folder)) for name, command in commands.items()}
    cpu = {name: statistics.median(each.cpu for each in of) for name, of in starts.items()}
    wall = {name: statistics.median(each.wall for each in of) for name, of in starts.items()}
    print(f"{'medians':28} {'CPU':>7} {'ratio':>6} {'wall':>7} {'ratio':>6} {'modules':>8}")
    for name in commands:
        ratios = cpu[name] / cpu[BARE], wall[name] / wall[BARE]
        print(f"{name:28} {cpu[name]:5.2f} s {ratios[0]:6.1f} {wall[name]:5.2f} s {ratios[1]:6.1f} {modules[name]:8}")
    print(f"target of each --help: {TARGET_S:g} s of CPU time")
    return 0 if all(seconds <= TARGET_S for name, seconds in cpu.items() if name.endswith("--help")) else 1


def _commands(folder: Path) -> dict[str, Command]:
    """The commands by their names; writes the files that they read."""
    manifest = yaml.safe_load((EXAMPLE / "detector.yaml").read_text())
    manifest["spec"]["zenoh"] = {"mode": "peer", "listen": [free_endpoint()]}
    (folder / "detector.yaml").write_text(yaml.safe_dump(manifest))
    task = {
        "apiVersion": "wayside.dev/v1alpha1",
        "kind": "ApplicationTask",
        "metadata": {"name": "wanted"},
        "spec": {"templateName": "scene-recorder", "parameters": {"vehicles": ["car1", "car2"]}},
    }
    (folder / "task.yaml").write_text(yaml.safe_dump(task))
    cluster = {"name": "none", "cluster": {"server": f"http://127.0.0.1:{free_port()}"}}
    context = {"name": "none", "context": {"cluster": "none", "user": "none"}}
    users = [{"name": "none", "user": {}}]
    kubeconfig = {"current-context": "none", "clusters": [cluster], "contexts": [context], "users": users}
    (folder / "kubeconfig").write_text(yaml.safe_dump({"apiVersion": "v1", "kind": "Config"} | kubeconfig))
    files = [f"--detector={folder}/detector.yaml", f"--rules={EXAMPLE}/rules.yaml"]
    rendered = [f"--templates={EXAMPLE}/templates.yaml", f"--tasks={folder}/task.yaml"]
    detector, manager = ([str(Path(sys.executable).with_name(each))] for each in ("detector", "application-manager"))
    return {
        BARE: Command(["-c", "pass"]),
        "detector --help": Command([*detector, "--help"]),
        "detector check": Command([*detector, "check", f"{folder}/detector.yaml", f"{EXAMPLE}/rules.yaml"]),
        "detector run": Command([*detector, "run", *files, f"--output={folder}/out"], RUNS),
        "application-manager --help": Command([*manager, "--help"]),
        "application-manager render": Command([*manager, "render", *rendered]),
        "application-manager run": Command([*manager, "run"], RETRIES),
    }


def _modules(command: Command, folder: Path) -> int:
    """How many modules the command loads."""
    _, log = _start(command._replace(words=["-X", "importtime", *command.words]), folder)
    return log.count(IMPORTED)


def _start(command: Command, folder: Path) -> tuple[Start, str]:
    """Start the command, and kill it when it prints `until`; also what it wrote on stderr up to then.

    Raises RuntimeError if it fails, TimeoutError if it does not print `until` in time or before its end.
    """
    environment = os.environ | {"KUBECONFIG": str(folder / "kubeconfig")}
    began = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, *command.words], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment, text=True
    )
    assert process.stderr is not None
    kill = partial(os.kill, process.pid, signal.SIGKILL)  # process.kill() may reap it, and wait4 would have no times
    limit = threading.Timer(PATIENCE, kill)
    limit.start()
    lines: list[str] = []
    try:
        for line in process.stderr:  # to its end, which is that of the process
            lines.append(line)
            if command.until is not None and command.until in line:
                break
        wall = time.monotonic() - began
        if command.until is not None:
            kill()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    finally:
        limit.cancel()
        process.kill()
        process.stderr.close()
    log = "".join(lines)
    if command.until is None and process.returncode:
        raise RuntimeError(f"{command.words} ended with {process.returncode}:\n{log[-2000:]}")
    if command.until is not None and command.until not in log:
        raise TimeoutError(f"{command.words} did not print {command.until!r}:\n{log[-2000:]}")
    return Start(wall, used.ru_utime + used.ru_stime), log


if __name__ == "__main__":
    sys.exit(main())
