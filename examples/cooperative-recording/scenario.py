"""The drive of the demo as a scenario for `python -m examples.running`; `cooperative_recording/` has all of it."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator

from cooperative_recording.expected import episodes, fusions
from cooperative_recording.messages import messages
from cooperative_recording.seeds import DEMO_DURATION_S, DEMO_SEED
from cooperative_recording.vehicles import simulate
from picture import svg

from examples.running.scenario import START_NS, Episode, Message, Moment, Scenario

RULE = "lidar-vehicles-close"
_LATE_S = 0.7
"""A pose comes every 0.1 s, and the rule looks every 0.5 s."""


def scenario(seed: int = DEMO_SEED) -> Scenario:
    """Fifteen vehicles for twenty-five seconds."""
    drive = simulate(seed)
    judge = episodes(drive, DEMO_DURATION_S)
    return Scenario(
        title="Cooperative recording",
        seed=seed,
        messages=lambda: (
            Message(each.after_ns, each.key, each.payload, "cdr", each.type)
            for each in messages(drive, START_NS, DEMO_DURATION_S)
        ),
        episodes=[Episode(RULE, "+".join(each.pair), each.start_s, each.end_s, _LATE_S) for each in judge],
        actions={f"{RULE}/record": len(judge), f"{RULE}/fuse": len(judge)},
        moments=list(_moments(seed)),
        picture=lambda: svg(drive, DEMO_DURATION_S),
        picture_file="drive.svg",
    )


def _moments(seed: int) -> Iterator[Moment]:
    """One in each stretch of time in which nothing changes."""
    judge = episodes(simulate(seed), DEMO_DURATION_S)
    places = fusions(judge, linger_s=0.0)
    ends = [each.end_s for each in judge if each.end_s is not None]
    changes = sorted({0.0, *(each.start_s for each in judge), *ends, DEMO_DURATION_S})
    for begin, end in itertools.pairwise(changes):
        at = end - 0.2
        if at - begin > _LATE_S + 0.2:
            runs: dict[str, dict[str, object]] = {
                f"scene-recorder/{json.dumps(each.pair, separators=(',', ':'))}": {}
                for each in judge
                if each.start_s <= at < (each.end_s or DEMO_DURATION_S)
            }
            for place, states in places.items():
                for state in states:
                    if state.start_s <= at < (state.end_s or DEMO_DURATION_S):
                        runs[f"scene-fusion/{place}"] = {"place": place, "sources": list(state.sources)}
            yield Moment(at, runs)
