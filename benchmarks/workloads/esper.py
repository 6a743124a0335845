"""The peer: Esper, driven by the program in `peers/esper`, which Maven builds from pinned packages."""

from __future__ import annotations

import json
import statistics
import subprocess
from pathlib import Path
from typing import NamedTuple

FOLDER = Path(__file__).parents[1] / "peers" / "esper"
JAR = FOLDER / "target" / "esper-peer-1.jar"

WARMUP = 1_000_000
"""Samples before the rounds that count."""


class Run(NamedTuple):
    """What the rounds took, and what each of them found."""

    thread: float
    """Median CPU time of the one thread that parses and evaluates, in seconds; without what the JVM's collector and
    compiler take."""
    jvm: float
    """CPU time of the whole JVM, that of this thread being 1."""
    wall: float
    """Median wall time in seconds."""
    tick: float
    """Median over the rounds of a tick's median CPU time on that thread, in seconds; a round's first does not count."""
    samples: int
    ticks: int
    starts: int
    ends: int


class PeerError(RuntimeError):
    """The peer cannot be built or does not run; the text gives the reason."""


def build() -> None:
    """Build the peer. Raises PeerError where Maven or Java is missing, or a package cannot be resolved."""
    _output(["mvn", "--quiet", "--batch-mode", "package"])


def run(mode: list[str], *, samples: int, rounds: int) -> Run:
    """Run the peer with the words that it takes before the numbers of rounds. Raises PeerError.

    `samples`: as many as the recording holds; the warm-up lasts until the JVM has compiled what counts.
    """
    warmup = max(5, -(-WARMUP // samples))
    java = ["java", "-Xms2g", "-Xmx4g", "-XX:+UseSerialGC", "-jar", str(JAR)]
    lines = [json.loads(line) for line in _output([*java, *mode, str(warmup), str(rounds)]).splitlines()]
    found = {(line["samples"], line["ticks"], line["starts"], line["ends"]) for line in lines}
    if len(found) != 1:
        raise PeerError(f"the rounds differ in (samples, ticks, starts, ends): {sorted(found)}")
    thread, process, wall = ([line["seconds"][name] for line in lines] for name in ("thread", "process", "wall"))
    jvm = max(1.0, sum(process) / sum(thread))  # the JVM counts its time in steps of 10 ms
    tick = statistics.median(line["tick"] for line in lines)
    return Run(statistics.median(thread), jvm, statistics.median(wall), tick, *found.pop())


def _output(command: list[str]) -> str:
    try:
        done = subprocess.run(command, cwd=FOLDER, capture_output=True, text=True, check=True)
    except FileNotFoundError as error:
        raise PeerError(f"{command[0]} is missing: install Maven and a JDK of version 17 or later") from error
    except subprocess.CalledProcessError as error:
        raise PeerError(f"{' '.join(command)} fails:\n{(error.stdout + error.stderr)[-3000:]}") from error
    return done.stdout
