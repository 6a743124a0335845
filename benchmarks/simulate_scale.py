"""The resources for 1,000, 100,000 and 10 million vehicles: measured unit costs, then a simulation of an hour.

Measured: CPU time and memory of a message, a vehicle and a task (`benchmarks/workloads/unit_costs.py`). Assumed: how
vehicles drive, send and need applications; every assumption is printed and can be changed. Simulated: each episode of
an hour with its start, its end and the borders that its vehicle crosses. From these follow the open tasks, the tasks
that two regions emit for one episode, and the time that tasks wait for a manager, which serves one after the other.
The rest is arithmetic.

    python -m benchmarks.simulate_scale [--assume NAME=VALUE …] [--save FILE | --costs FILE]

Prints the tables that docs/scale.md quotes, and the ratio of the detector's cost of a message to that of a bare
subscriber in the same run. `--save` keeps the measured costs, `--costs` uses them again.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.workloads.unit_costs import CROWD, REGION_RULES, VEHICLES, UnitCosts, measure

FLEETS = (1_000, 100_000, 10_000_000)
HOUR = 3600.0
LEASE = 5.0
"""Seconds between two renewals of a holder's Lease."""

Times = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Assumptions:
    """What is not measured. Vehicles are those that drive and send at the same time."""

    load: float = 0.5
    """How much of its cores a program may use on average."""
    detector_cores: float = 1.0
    """A detector's receiving and evaluating share the interpreter's lock."""
    router_cores: float = 4.0
    on_board: float = 1000.0
    """Messages a second inside a vehicle: 20 topics with 50 Hz."""
    roadside: float = 10.0
    """Messages a second to roadside units: CAM at its highest rate."""
    regional: float = 1.0
    """Messages a second to the region."""
    message_bytes: float = 200.0
    """With key and headers, to the region."""
    episodes: float = 0.5
    """Of a vehicle in an hour that need an application in the cluster."""
    minutes: float = 2.0
    """Of such an episode, on average."""
    burst: float = 0.02
    """The share of a city's vehicles that need one within a minute, such as at the first rain."""
    density: float = 100.0
    """Vehicles on a square kilometre of a city."""
    speed: float = 10.0
    """m/s, through the city."""
    strip: float = 200.0
    """Metres of the border within which both regions see a vehicle."""
    cities: float = 100.0
    """Of the largest fleet, with sizes by Zipf's law; smaller fleets are one city."""
    city_events: float = 60.0
    """Events an hour that a city reports to the country's detector, each with a demand there."""


@dataclass(frozen=True)
class City:
    """What one cluster with its managers sees in an hour."""

    vehicles: int
    regions: int
    tasks: int
    shared: float
    """The share of tasks that another region's task had preceded for the same episode."""
    open: int
    """At the same time, at most."""
    instances: int
    """Of these, as many applications."""
    second: int
    """New tasks in the busiest second."""
    managers: int
    wait: float
    """Seconds from a task to the manager's turn, in 99 of 100 cases."""
    burst_wait: float
    """The longest in a burst."""


def main() -> int:
    """Measure, simulate and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--assume", nargs="*", default=[], metavar="NAME=VALUE", help="instead of the default")
    parser.add_argument("--tasks", type=int, default=200, help="of the manager's measurement (%(default)s)")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each reading of a detector (%(default)g)")
    parser.add_argument("--seed", type=int, default=1, help="of the simulation (%(default)s)")
    kept = parser.add_mutually_exclusive_group()
    kept.add_argument("--save", type=Path, metavar="FILE", help="keep the measured costs")
    kept.add_argument("--costs", type=Path, metavar="FILE", help="use costs that were kept")
    options = parser.parse_args()
    try:
        assumed = assumptions(options.assume)
    except ValueError as error:
        parser.error(str(error))
    if options.costs is not None:
        costs = UnitCosts(**json.loads(options.costs.read_text()))
    else:
        costs = measure(options.tasks, options.seconds)
    if options.save is not None:
        options.save.write_text(json.dumps(dataclasses.asdict(costs), indent=1))
    print_costs(costs)
    print_assumptions(assumed)
    print_placements(costs, assumed)
    print_clusters(costs, assumed, np.random.default_rng(options.seed))
    ratio = costs.detector_message / costs.bare_message
    print(f"\nA message costs a detector {ratio:.2f} times what it costs a bare subscriber, in the same run.")
    return 0


def assumptions(given: Iterable[str]) -> Assumptions:
    """The defaults with what is given. Raises ValueError."""
    changed = {}
    names = [field.name for field in dataclasses.fields(Assumptions)]
    for each in given:
        name, _, value = each.partition("=")
        if name not in names:
            raise ValueError(f"--assume {each}: no assumption {name!r}; there are {', '.join(names)}")
        try:
            changed[name] = float(value)
        except ValueError:
            raise ValueError(f"--assume {each}: {value!r} is not a number") from None
        if not changed[name] > 0:
            raise ValueError(f"--assume {each}: give a number above 0")
    return Assumptions(**changed)


def per_detector(costs: UnitCosts, assumed: Assumptions, rate: float) -> int:
    """Vehicles of a detector that receives `rate` messages a second of each, with the rules that were measured.

    One message a second is part of what a vehicle costs; more of them cost what they cost under a flood.
    """
    each = costs.vehicle_second + costs.pair_second + max(0.0, rate - 1) * costs.detector_message
    return max(1, int((assumed.detector_cores * assumed.load - costs.detector_idle) / each))


def simulate(vehicles: int, costs: UnitCosts, assumed: Assumptions, random: np.random.Generator) -> City:
    """An hour of a city, after the time that the longest episodes need to be as frequent as they stay."""
    regions = math.ceil(vehicles / per_detector(costs, assumed, assumed.regional))
    starts, ends, episodes = tasks_of(vehicles, regions, assumed, random)
    within = (starts >= 0) & (starts < HOUR)
    seconds = np.bincount(starts[within].astype(int), minlength=int(HOUR)) if within.any() else np.zeros(1, int)
    whole = costs.manager_start + costs.manager_end
    managers = max(1, math.ceil(len(starts[within]) / HOUR * whole / assumed.load))
    rush = np.sort(random.uniform(0, 60, round(vehicles * assumed.burst)))
    both = np.concatenate([starts[within], np.sort(ends[(ends >= 0) & (ends < HOUR)])])
    first = np.unique(episodes[within], return_index=True)[1]
    return City(
        vehicles=vehicles,
        regions=regions,
        tasks=int(within.sum()),
        shared=1 - len(first) / max(1, int(within.sum())),
        open=most_open(starts, ends),
        instances=most_open(*spans(starts, ends, episodes)),
        second=int(seconds.max()),
        managers=managers,
        wait=float(np.quantile(waits(both, whole / 2, managers, random), 0.99)),
        burst_wait=float(waits(rush, costs.manager_start, managers, random).max(initial=0.0)),
    )


def tasks_of(
    vehicles: int, regions: int, assumed: Assumptions, random: np.random.Generator
) -> tuple[Times, Times, npt.NDArray[np.int64]]:
    """Start and end of each task in seconds, and its episode, in order of the starts.

    An episode has one task for each region that its vehicle passes. Vehicles that drive straight on in any direction
    leave a convex area at the rate speed x circumference / (pi x area). The next region's task begins when the vehicle
    enters the strip, and the former one's ends when it has left the strip.
    """
    length = assumed.minutes * 60
    before = 10 * length
    count = int(random.poisson(vehicles * assumed.episodes * (HOUR + before) / HOUR))
    begin = random.uniform(-before, HOUR, count)
    end = begin + random.exponential(length, count)
    side = math.sqrt(vehicles / regions / assumed.density) * 1000
    rate = 4 * assumed.speed / (math.pi * side) if regions > 1 else 0.0
    crossings = random.poisson(rate * (end - begin))
    episodes = np.repeat(np.arange(count), crossings + 1)
    borders = random.uniform(np.repeat(begin, crossings), np.repeat(end, crossings))
    # In each episode, the first task begins with it and the last one ends with it; in between, borders in their order.
    order = np.lexsort((borders, np.repeat(np.arange(count), crossings)))
    borders = borders[order]
    firsts = np.cumsum(crossings + 1) - (crossings + 1)
    is_first = np.isin(np.arange(len(episodes)), firsts)
    starts, ends = np.empty(len(episodes)), np.empty(len(episodes))
    starts[is_first], starts[~is_first] = begin, borders
    lasts = np.roll(is_first, -1)
    ends[lasts], ends[~lasts] = end, np.minimum(borders + assumed.strip / assumed.speed, np.repeat(end, crossings))
    ordered = np.argsort(starts, kind="stable")
    return starts[ordered], ends[ordered], episodes[ordered]


def spans(starts: Times, ends: Times, episodes: npt.NDArray[np.int64]) -> tuple[Times, Times]:
    """From when to when each episode has an application: tasks of one key share it."""
    count = int(episodes.max(initial=-1)) + 1
    begin, end = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(begin, episodes, starts)
    np.maximum.at(end, episodes, ends)
    return begin, end


def most_open(starts: Times, ends: Times) -> int:
    """How many are open at the same time within the hour, at most."""
    times = np.concatenate([starts, ends])
    changes = np.repeat([1, -1], [len(starts), len(ends)])
    order = np.argsort(times, kind="stable")
    return int(np.cumsum(changes[order])[(times[order] >= 0) & (times[order] < HOUR)].max(initial=0))


def waits(arrivals: Times, service: float, servers: int, random: np.random.Generator) -> Times:
    """Seconds that each arrival waits, where each of the servers works off its own in order, with equal service."""
    mine = random.integers(0, servers, len(arrivals))
    found = [np.zeros(1)]
    for server in range(servers):
        times = np.sort(arrivals[mine == server])
        before = np.arange(len(times)) * service
        found.append(np.maximum.accumulate(times - before) + before - times)
    return np.concatenate(found)


def print_costs(costs: UnitCosts) -> None:
    """The measured units."""
    micro = 1e6
    dearest = f"{costs.vehicle_second_most * micro:.0f}"
    rows = [
        ("a message through a Zenoh router", f"{costs.router_message * micro:.0f} us"),
        ("a message to a bare subscriber, under a flood", f"{costs.bare_message * micro:.1f} us"),
        ("a message to a detector with one rule, under the same flood", f"{costs.detector_message * micro:.1f} us"),
        (
            f"a vehicle with 1 Hz in a regional detector with {REGION_RULES} rules, {VEHICLES:,} vehicles",
            f"{costs.vehicle_second * micro:.0f} us a second ({dearest} in the most expensive run), "
            f"{costs.vehicle_bytes / 1e3:.0f} kB",
        ),
        (f"a vehicle in a rule about pairs, {CROWD:,} vehicles", f"{costs.pair_second * micro:.0f} us a second"),
        (
            "a regional detector without vehicles",
            f"{costs.detector_idle:.1%} of a core, {costs.detector_bytes / 2**20:.0f} MiB",
        ),
        ("a task in the manager, start and end", f"{costs.manager_start * 1e3:.1f} + {costs.manager_end * 1e3:.1f} ms"),
        (
            "a task in API server, etcd and controllers, with a pod that nobody runs",
            f"{costs.cluster_task * 1e3:.0f} ms, {costs.writes:.0f} writes, {costs.task_bytes / 1e3:.0f} kB of objects",
        ),
        (
            "the manager's memory",
            f"{costs.manager_bytes / 2**20:.0f} MiB, {costs.manager_task_bytes / 1e3:.0f} kB a task",
        ),
    ]
    table("measured, CPU time", ["unit", "cost"], rows)


def print_assumptions(assumed: Assumptions) -> None:
    """All of them."""
    table("assumed", ["name", "value"], [(name, f"{value:g}") for name, value in dataclasses.asdict(assumed).items()])


def print_placements(costs: UnitCosts, assumed: Assumptions) -> None:
    """How much goes through routers and into detectors, by where data is evaluated."""
    rows = []
    for fleet in FLEETS:
        for what, rate in (
            ("all data in the center", assumed.on_board),
            ("CAM in the center", assumed.roadside),
            ("at the edge; a digest in the regions", assumed.regional),
        ):
            messages = fleet * rate
            routers = messages * costs.router_message / (assumed.router_cores * assumed.load)
            rows.append(
                (
                    f"{fleet:,}",
                    what,
                    number(messages),
                    f"{number(messages * assumed.message_bytes * 8 / 1e6)} Mbit/s",
                    f"{math.ceil(routers):,}",
                    f"{math.ceil(fleet / per_detector(costs, assumed, rate)):,}",
                )
            )
    dearest = dataclasses.replace(costs, vehicle_second=costs.vehicle_second_most)
    most, least = (per_detector(each, assumed, assumed.regional) for each in (costs, dearest))
    table(
        f"messages; a regional detector has at most {most:,} vehicles, {least:,} in the most expensive run",
        ["vehicles", "evaluated", "messages a second", "bandwidth", "routers", "detectors"],
        rows,
    )


def print_clusters(costs: UnitCosts, assumed: Assumptions, random: np.random.Generator) -> None:
    """What the managers of cities, and that of the country, see."""
    rows = []
    for fleet in FLEETS:
        sizes = city_sizes(fleet, assumed)
        cities = [simulate(size, costs, assumed, random) for size in sizes]
        what = "the city" if len(cities) == 1 else f"the largest of {len(cities)} cities"
        rows.append((f"{fleet:,}", what, *city_row(cities[0], costs)))
        if len(cities) > 1:
            rows.append(
                (f"{fleet:,}", f"the {len(cities) // 2}th city", *city_row(cities[len(cities) // 2 - 1], costs))
            )
            rate = len(cities) * assumed.city_events / HOUR
            rows.append(
                (
                    f"{fleet:,}",
                    "the country",
                    f"{len(cities)} cities, {sum(each.regions for each in cities):,} regions",
                    f"{rate:.1f}",
                    "-",
                    f"{rate * assumed.minutes * 60:.0f}",
                    f"{rate * assumed.minutes * 60:.0f}",
                    "1",
                    "-",
                    "-",
                    f"{rate * costs.writes:.0f}",
                    f"{rate * costs.cluster_task:.1f}",
                    "-",
                )
            )
    table(
        "tasks",
        [
            *("vehicles", "cluster", "regions", "tasks a second", "busiest second", "open tasks", "applications"),
            *("managers", "wait p99", "after a burst", "writes a second", "cores of the control plane", "objects"),
        ],
        rows,
    )
    rows = [(f"{it:,}", number(it / LEASE), number(sum_regions(it, costs, assumed) / LEASE)) for it in FLEETS]
    table("renewals of Leases a second", ["vehicles", "a holder in each vehicle", "a holder for each region"], rows)


def sum_regions(fleet: int, costs: UnitCosts, assumed: Assumptions) -> int:
    """Regional detectors of all cities."""
    return sum(math.ceil(size / per_detector(costs, assumed, assumed.regional)) for size in city_sizes(fleet, assumed))


def city_sizes(fleet: int, assumed: Assumptions) -> list[int]:
    """Vehicles of each city, the largest first."""
    if fleet < max(FLEETS):
        return [fleet]
    shares = 1 / np.arange(1, round(assumed.cities) + 1)
    return [round(fleet * share) for share in shares / shares.sum()]


def city_row(city: City, costs: UnitCosts) -> tuple[str, ...]:
    """Of the table."""
    rate = city.tasks / HOUR
    return (
        f"{city.vehicles:,} in {city.regions:,}",
        f"{rate:.1f} ({city.shared:.0%} at borders)",
        str(city.second),
        f"{city.open:,}",
        f"{city.instances:,}",
        str(city.managers),
        span(city.wait),
        span(city.burst_wait),
        f"{rate * costs.writes:,.0f}",
        f"{rate * costs.cluster_task:.1f}",
        f"{city.open * costs.task_bytes / 2**20:.0f} MiB",
    )


def span(seconds: float) -> str:
    """For people."""
    return f"{seconds * 1e3:.0f} ms" if seconds < 1 else f"{seconds:.0f} s"


def number(value: float) -> str:
    """With few digits."""
    for unit, size in (("billion", 1e9), ("million", 1e6)):
        if value >= size:
            return f"{value / size:,.0f} {unit}"
    return f"{value:,.0f}" if value >= 10 else f"{value:.2g}"


def table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """As Markdown."""
    print(f"\n{title}:\n")
    print("| " + " | ".join(head) + " |")
    print("|" + "---|" * len(head))
    for row in rows:
        print("| " + " | ".join(row) + " |")


if __name__ == "__main__":
    sys.exit(main())
