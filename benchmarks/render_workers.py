"""The cost of a render through the worker processes, beside one in this process.

The template is that of `task_to_deployment`: one Deployment. Both are compiled before they are timed. Rounds alternate;
a time is the median over all renders. A second figure is the start of a worker, to its first answer. Exits with 1 where
a render through the workers takes a millisecond longer: it would show in the way from a task to its Deployment.

    python -m benchmarks.render_workers [--renders 500] [--rounds 5]
"""

from __future__ import annotations

import argparse
import asyncio
import pickle
import statistics
import sys
import time
from functools import partial

from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import Renderer, Rendering
from application_manager.measures import Measures
from application_manager.workers.jobs import render_instance
from application_manager.workers.pool import Pool
from benchmarks.task_to_deployment import TEMPLATE
from wayside.api import ApplicationInstance, ApplicationTemplate
from wayside.api.applicationinstance import ApplicationInstanceSpec
from wayside.api.base import Metadata

TARGET = 1e-3  # s that the way through a worker may add


def instance(number: int) -> ApplicationInstance:
    """One of as many as there are numbers."""
    spec = ApplicationInstanceSpec(template_name="app", key=f"r{number}", parameters={"region": f"r{number}"})
    return ApplicationInstance(metadata=Metadata(name=f"app-{number}", namespace="site"), spec=spec)


async def measured(renders: int, rounds: int) -> tuple[float, float, float]:
    """Seconds: of the start of a worker, of a render through it, and of one in this process."""
    template = ApplicationTemplate.model_validate(
        {**TEMPLATE, "metadata": {"name": "app", "namespace": "site", "uid": "u", "generation": 1}}
    )
    pool, renderer, written = Pool(Measures()), Renderer(template, Policy()), pickle.dumps(template)
    through: list[float] = []
    inside: list[float] = []
    try:
        began = time.perf_counter()
        await pool.run("site", partial(render_instance, written, Policy(), instance(0)))
        start = time.perf_counter() - began
        for _ in range(rounds):
            for number in range(renders):
                began = time.perf_counter()
                found = await pool.run("site", partial(render_instance, written, Policy(), instance(number)))
                through.append(time.perf_counter() - began)
                assert isinstance(found, Rendering)
            for number in range(renders):
                began = time.perf_counter()
                here = renderer.render(instance(number))
                inside.append(time.perf_counter() - began)
            assert here == found
    finally:
        await pool.close()
    return start, statistics.median(through), statistics.median(inside)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--renders", type=int, default=500)
    parser.add_argument("--rounds", type=int, default=5)
    given = parser.parse_args()
    start, through, inside = asyncio.run(measured(given.renders, given.rounds))
    print(f"a worker's start, to its first answer  {start * 1e3:8.1f} ms")
    print(f"a render in this process               {inside * 1e3:8.3f} ms")
    print(f"a render through the workers           {through * 1e3:8.3f} ms   {through / inside:.1f} times")
    if through - inside > TARGET:
        sys.exit(f"a render through the workers takes {(through - inside) * 1e3:.2f} ms longer, more than 1 ms")


if __name__ == "__main__":
    main()
