"""Random scenes: rules of every scope, what comes in, and what is done to the engine meanwhile.

A scene follows from its seed. It is driven in cuts: each is one call of `Engine.advance`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from typing import Any, NamedTuple

from detector.assembly import RuleIndex, make_engine, stream_readers
from detector.engine.counters import RuleCounters
from detector.engine.engine import NotEvaluableError
from detector.engine.samples.sample import Arrival
from detector.engine.scoping.scopes import Evaluated
from tests.driving import SECOND, START, a_detector, a_stream
from tests.unit.engine.random_rules import PLACES, POSITION, a_random_rule
from wayside.api import Detector

_VALUES: list[dict[str, Any]] = [
    {}, {"v": None}, {"v": "x"}, {"v": True}, {"w": 1}, {"v": 1, "w": 2}, {"v": 0.0}, {"v": -0.0}, {"v": 0.1},
    {"v": [1]},
    {"v": 2**60, "big": 2**60 + 1}, {"v": 1e308, "big": -(2**62)}, {"v": 1e-7},
]  # fmt: skip


class Operation(NamedTuple):
    """An operation on the engine."""

    kind: str
    what: Any
    until: int = 0
    """Of an advance, how far time comes; nanoseconds."""


@dataclass(frozen=True)
class Scene:
    detector: Detector
    operations: list[Operation]


def _message(random: Random, stream: str) -> dict[str, Any]:
    if stream == "s":
        return dict(random.choice([{"v": round(random.uniform(-1, 5), 1)}] * 14 + _VALUES))
    if stream == "o":
        item = {"v": random.choice([0, 1, 2.5, None]), "at": random.choice([[1.0, 2.0]] * 5 + [3, []]), "gear": "D"}
        return {
            "f": random.choice([1, 2]),
            "objects": [{**item, "id": number} for number in random.sample(range(6), 3)],
        }
    place = {"w": random.uniform(0, 4), "z": random.choice([0, 1, 2.0])}
    message = {
        "gear": random.choice(["D", "D", "R", 1, None]),
        "on": random.choice([True, False, 1.0]),
        "q": random.choice([place] * 5 + [{}, None, {"w": "k"}, 7, [1.5, 2]]),
    }
    return {name: value for name, value in message.items() if random.random() > 0.1}


def _arrivals(random: Random, data: bool) -> list[Arrival]:
    """In order of time; many come at a tick, some together, and clients fall silent for as long as makes them lost."""
    sent = []
    for client in range(3):
        time = 0.0
        while time < 5:
            time += (
                random.expovariate(random.choice([5, 20])) if random.random() > 0.03 else random.choice([0.6, 1.3, 3])
            )
            sent.append((time, f"c{client}", random.choice("sspo")))
    arrivals, last = [], START
    for time, client, stream in sorted(sent):
        last = max(last + (random.random() > 0.05), START + round(time * 1e8) * 10)
        if random.random() < 0.1:
            last = -(-last // 10**8) * 10**8
        message = _message(random, stream)
        if data:
            message["t"] = last / 1e9 + random.choice([0, 0, 0, -0.1, -0.3, 0.05])
        payload = b"{broken" if random.random() < 0.01 else json.dumps(message).encode()
        whose = "stations" if stream == "o" else "vehicles"
        arrivals.append(Arrival(last, stream, f"{whose}/{client}/{stream}", payload))
    return arrivals


def a_scene(seed: int) -> Scene:
    random = Random(seed)
    data = random.random() < 0.25
    stamp = {"stamp": "msg.t"} if data else {}
    buffer = {"duration": random.choice(["3s", "5s"]), **random.choice([{}, {}, {}, {"bytes": "6k"}])}
    capped = random.choice([{}] * 9 + [{"buffer": {"count": 5}}])
    detector = a_detector(
        a_stream("s", staleAfter=random.choice(["500ms", "1s", "Never"]), **capped, **stamp),
        a_stream("p", staleAfter="1s", position=POSITION, **stamp),
        {"name": "o", "key": "stations/${station:*}/o", "encoding": "json", "staleAfter": "500ms", **stamp,
         "items": "msg.objects", "client": "c${item.id}"},
        places=PLACES,
        clientTimeout="2s", buffer=buffer, clock="Data" if data else "Wall", **({"lateness": "200ms"} if data else {}),
        clients=[{"name": "c0", "labels": {"kind": "bus"}},
                 {"name": "c1", "labels": {"kind": "car"}, "parameters": {f"r{random.randrange(5)}": {"f": 2.5}}}],
    )  # fmt: skip
    mixed = random.random() < 0.5
    kinds = ["client"] * 2 + (random.choices(["client", "over", "fleet", "pairs"], k=3) if mixed else ["client"] * 3)
    rules = [a_random_rule(random, number, kind) for number, kind in enumerate(kinds)]
    arrivals = _arrivals(random, data)
    operations, done = [Operation("rules", rules)], 0
    for mark in sorted(random.sample(range(1, len(arrivals)), random.choice([0, 1, 2, 3]))):
        while mark < len(arrivals) and arrivals[mark].received == arrivals[mark - 1].received:
            mark += 1  # noqa: PLW2901
        if not done < mark < len(arrivals):
            continue
        operations.append(Operation("advance", arrivals[done:mark], arrivals[mark - 1].received))
        done = mark
        match random.choice(["rules", "pause", "resume", "level", "ask", *([] if data else ["gap"])]):
            case "rules":
                for at in range(len(rules)):
                    if random.random() < 0.3:
                        rules = [*rules[:at], a_random_rule(random, at, "client"), *rules[at + 1 :]]
                operations.append(Operation("rules", rules))
            case "pause":
                operations.append(Operation("pause", random.sample([rule.name for rule in rules], 2)))
            case "resume":
                operations.append(Operation("pause", []))
            case "level":
                operations.append(Operation("level", random.choice([0, 1, 2, 5])))
            case "ask":
                operations.append(Operation("ask", random.choice(rules).name))
            case "gap":
                operations.append(Operation("gap", arrivals[done].received - 1))
    operations.append(Operation("advance", arrivals[done:], arrivals[-1].received + 3 * SECOND))
    return Scene(detector, [*operations, Operation("finish", None)])


class Outcome(NamedTuple):
    """The result of a scene."""

    events: list[str]
    demands: list[list[tuple[str, str]]]
    """After each operation."""
    counters: dict[str, Any]


def driven(scene: Scene, cut: Callable[[], int], *, one_by_one: bool = False) -> Outcome:
    """Drive the scene; `cut` is the minimum number of arrivals in one call: those of equal times come together.

    `one_by_one`: every rule is evaluated by CEL, subject by subject, as if somebody watched each evaluation.
    """
    readers, index = stream_readers(scene.detector), RuleIndex()
    engine = make_engine(scene.detector, readers, holder="h", start=START - 1)
    engine.counters.watch_ages = True
    events: list[str] = []
    demands = []
    for kind, what, until in scene.operations:
        found = []
        match kind:
            case "rules":
                found += engine.set_rules(index.compile(what, scene.detector, readers.fields)[0])
                for run in engine.rules.values() if one_by_one else ():
                    run.on_evaluated = _nobody
            case "pause":
                engine.set_paused(what)
            case "level":
                engine.set_level(what)
            case "gap":
                found += engine.gap(what)
            case "ask":
                try:
                    found, answers = engine.evaluate_now(what)
                    events.append(str(answers))
                except NotEvaluableError:
                    pass
            case "finish":
                found += [event for some in engine.finish() for event in some]
            case "advance":
                begin = 0
                while begin < len(what):
                    end = begin + cut()
                    while end < len(what) and what[end].received == what[end - 1].received:
                        end += 1
                    last = end >= len(what)
                    found += engine.advance(what[begin:end], until if last else what[end - 1].received)
                    begin = end
        events += [event.to_json() for event in found]
        demands.append(sorted((name, str(each.parameters)) for name, each in engine.demands().items()))
    # A sample that cannot be read counts once for each time at which somebody reads it.
    counted = {name: _counted(each) for name, each in sorted(engine.counters.rules.items())}
    return Outcome(events, demands, {**counted, "undecodable": sorted(engine.counters.undecodable)})


def _nobody(_: Evaluated) -> None:
    """Watches."""


def _counted(rule: RuleCounters) -> dict[str, Any]:
    numbers = ("evaluations", "skipped", "suppressed", "started", "ended", "unfollowed", "ticks")
    uses = rule.ages.uses if rule.ages is not None else {}
    return {name: getattr(rule, name) for name in numbers} | {
        # Of several reasons for an unknown, the one of one point counts for all points that look alike.
        "unknowns": rule.unknowns + rule.errors,
        "ages": {stream: (dict(use.ages), dict(use.periods)) for stream, use in sorted(uses.items())},
    }
