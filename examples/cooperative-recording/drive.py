"""Drive: fifteen vehicles publish poses and point clouds over Zenoh, or into an MCAP file. Try `drive.py --help`."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path

from cooperative_recording.publish import UnreachableError, publish
from cooperative_recording.record import START_NS, record
from cooperative_recording.seeds import DEMO_DURATION_S, DEMO_SEED
from cooperative_recording.vehicles import simulate

DETECTOR = "tcp/127.0.0.1:7447"
"""The endpoint at which the detector of detector.yaml listens."""


def main() -> int:
    """Run the drive of the command line; 2 means that its options are impossible."""
    options = _options()
    drive = simulate(options.seed, horizon_s=options.duration)
    if options.record is not None:
        try:
            count = record(
                drive, options.record, options.duration, START_NS if options.start is None else options.start
            )
        except OSError as error:
            print(
                f"drive.py: --record {options.record}: {error.strerror}: give a file that can be written",
                file=sys.stderr,
            )
            return 2
        print(f"{count} messages of {options.duration:g} s (seed {options.seed}) in {options.record}")
        return 0
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    try:
        done = publish(
            drive,
            options.duration,
            connect=options.connect or ([] if options.listen else [DETECTOR]),
            listen=options.listen,
            start_ns=options.start,
            speed=options.speed,
            wait_s=options.wait,
            stop=stop,
        )
    except UnreachableError as error:
        print(f"drive.py: {error}", file=sys.stderr)
        return 2
    print(
        f"{done.messages} messages, {done.bytes / 1e6:.1f} MB (seed {options.seed}), stamps from {done.start_ns} ns, "
        f"at most {done.lag_s * 1000:.0f} ms late"
        + ("" if done.complete else "; stopped early")
        + ("" if done.listened else "; nobody listened at its start")
    )
    return 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="drive.py", description=__doc__)
    positive = _number(above=0.0)
    parser.add_argument("--seed", type=_seed, default=DEMO_SEED, help="routes, phases and briskness (%(default)s)")
    parser.add_argument("--duration", type=positive, default=DEMO_DURATION_S, metavar="S", help="seconds (%(default)g)")
    parser.add_argument("--speed", type=positive, default=1.0, help="times as fast as it happens (%(default)g)")
    parser.add_argument(
        "--start", type=int, metavar="NS", help="the first stamp in ns since the epoch; if soon, wait for it"
    )
    parser.add_argument(
        "--connect", action="append", default=[], metavar="ENDPOINT", help=f"Zenoh endpoint ({DETECTOR})"
    )
    parser.add_argument("--listen", action="append", default=[], metavar="ENDPOINT", help="listen instead, or as well")
    parser.add_argument(
        "--wait", type=_number(above=-1.0), default=10.0, metavar="S", help="for a listener, at most (%(default)g)"
    )
    parser.add_argument("--record", type=Path, metavar="FILE", help="write an MCAP file at once instead of publishing")
    return parser.parse_args()


def _number(above: float) -> Callable[[str], float]:
    def parse(text: str) -> float:
        value = float(text)
        if not above < value < 1e6:
            raise argparse.ArgumentTypeError(f"{text}: give a number between {above:g} and a million")
        return value

    return parse


def _seed(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text}: give a whole number from 0 upwards")
    return value


if __name__ == "__main__":
    sys.exit(main())
