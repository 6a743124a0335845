"""CPU time of a tick of rules about the fleet, in columns and with CEL for every member.

The speeds of engine_speed at 10 Hz. Rule k checks whether a number of clients had a maximum above a limit in the last
1 to 5 s, each 100 ms. The baseline is the same engine with `on_evaluated`, which makes it evaluate rules one by one.

    python -m benchmarks.fleet_speed [--rules 10] [--clients 100] [--ticks 30]

Exits with 1 where the two have different events.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Sequence

from benchmarks.workloads import speeds
from benchmarks.workloads.driving import Live, by_tick
from detector.engine.episodes.events import Event
from wayside.api import EventRule

HZ = 10


def main() -> int:
    """Measure and print; 1 means that the events differ."""
    parser = argparse.ArgumentParser(prog="fleet_speed", description=__doc__)
    parser.add_argument("--rules", type=int, default=10, help="(%(default)s)")
    parser.add_argument("--clients", type=int, default=100, help="(%(default)s)")
    parser.add_argument("--ticks", type=int, default=30, help="that count (%(default)s)")
    options = parser.parse_args()
    rules = [rule(each, options.clients // 2) for each in speeds.limits(options.rules)]
    measure(rules, options.clients, 2, watched=False)  # warm up the imports
    columns, events = measure(rules, options.clients, options.ticks, watched=False)
    one_by_one, expected = measure(rules, options.clients, options.ticks, watched=True)
    same = [each.to_json() for each in events] == [each.to_json() for each in expected]
    print(
        f"{len(rules)} rules about {options.clients} clients: median {columns * 1e3:,.2f} ms a tick in columns, "
        f"{one_by_one * 1e3:,.2f} ms one by one: {one_by_one / columns:,.1f} times; "
        f"{len(events)} events, {'the same' if same else 'OTHER EVENTS'}"
    )
    return 0 if same else 1


def rule(limit: speeds.Limits, many: int) -> EventRule:
    """More than `many` clients are above the limit, until fewer are."""
    document = speeds.rule_document(limit, {"every": "100ms"})
    document["spec"] |= {
        "scope": {"fleet": {"members": "true"}},
        "when": f"size(members.filter(m, m.top > {limit.above})) > {many}",
        "until": f"size(members.filter(m, m.top > {limit.above})) < {many}",
    }
    return EventRule.model_validate(document)


def measure(rules: Sequence[EventRule], clients: int, ticks: int, *, watched: bool) -> tuple[float, list[Event]]:
    """The median of seconds of CPU time a tick, once the windows are full, and all events."""
    before = speeds.LONGEST * HZ
    arrivals = list(speeds.arrivals(clients, HZ, (before + ticks + 1) / HZ))
    live = Live(speeds.detector(), rules, speeds.START - 1)
    if watched:
        live.watch()
    spent, events = [], []
    for tick, part in list(by_tick(arrivals, speeds.TICK))[: before + ticks]:
        begin = time.process_time()
        events += live.advance(part, tick)
        spent.append(time.process_time() - begin)
    return statistics.median(spent[before:]), events


if __name__ == "__main__":
    sys.exit(main())
