"""Bad input to the chain: each has a helpful message, and a well-behaved pair's episode is not affected.

In each test CARS are the well-behaved pair. Their episode opens before the bad input, stays open
during it with the two at 175 m, and ends as expected afterwards.
"""

from __future__ import annotations

import os
import re
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from random import Random

import pytest
import yaml

from tests import programs
from tests.cluster.api import Api, Object
from tests.cluster.chain import (
    BETWEEN,
    BUSES,
    CARS,
    FAR,
    HOLDER,
    NEAR,
    VANS,
    Chain,
    Vehicles,
    cdr_pose,
    cdr_stream,
    detector,
    recording,
    rule,
    template,
    untouched,
)
from tests.cluster.expected_objects import condition
from tests.cluster.processes import Process, Processes
from tests.ros_messages import cdr, pose_stamped

HOUR = 3600  # s


@pytest.fixture
def chain(api: Api, namespace: str, processes: Processes, tmp_path: Path) -> Chain:
    made = Chain(api, namespace, processes, tmp_path / "out")
    made.apply(template())
    return made


@contextmanager
def unharmed(chain: Chain, vehicles: Vehicles, running: Process) -> Iterator[None]:
    """The well-behaved pair's episode is open during the block; neither it nor its Deployment changes."""
    vehicles.place(CARS, NEAR)
    deployed = chain.wait_deployed(CARS)
    task = chain.wait_task(CARS)
    vehicles.place(CARS, BETWEEN)
    yield
    assert running.alive
    again = chain.wait_task(CARS)
    assert (again["metadata"]["uid"], again["spec"]) == (task["metadata"]["uid"], task["spec"])
    assert untouched(deployed, chain.deployment(CARS))
    vehicles.place(CARS, FAR)
    chain.wait_events(CARS, "started", "Until")
    chain.wait_removed(CARS)
    chain.settled()


def in_turn(*payloads: Callable[[], bytes]) -> Callable[[], bytes]:
    """Repeat the items endlessly."""
    following = cycle(payloads)
    return lambda: next(following)()  # noqa: PLW0108  each call returns the next item


def test_a_client_with_unreadable_or_invalid_poses_affects_no_other_client(chain: Chain) -> None:
    random = Random(7)
    senseless = in_turn(
        lambda: b"",
        lambda: cdr_pose(0.0, 0.0)[: random.randrange(60)],
        lambda: random.randbytes(60),
        lambda: cdr_pose(0.0, 0.0)[:4] + random.randbytes(60),
        lambda: cdr_pose(float("nan"), 0.0),
        lambda: cdr_pose(0.0, float("-inf")),
    )
    chain.apply(rule(position="msg.pose.position"), detector(chain.endpoint, streams=[cdr_stream()]))
    with Vehicles(chain.endpoint, cdr_pose) as vehicles:
        harms_nobody(
            chain,
            vehicles,
            senseless,
            r"a sample of stream pose could not be read; the last: vehicles/van1/pose: not CDR of geometry_msgs",
            r"a sample had no position for EventRule close; the last: [xy] of van1 is ",
        )


def test_json_of_the_wrong_shape_affects_no_other_client(chain: Chain) -> None:
    shapes = (
        *('{"x": 1, "y"', "[1, 2]", '"north"', "null", '{"y": 0}', '{"x": "far", "y": 0}', '{"x": {"deep": 1}}'),
        *('{"x": 1e999, "y": 0}', '{"x": NaN, "y": 0}', "[" * 100_000),
    )
    chain.apply(rule(), detector(chain.endpoint))
    with Vehicles(chain.endpoint) as vehicles:
        harms_nobody(
            chain,
            vehicles,
            in_turn(*(text.encode for text in shapes)),
            r"a sample of stream pose could not be read; the last: vehicles/van1/pose: (not JSON|JSON nested)",
            r"evaluation errors in EventRule close; the last: ",
            r"a sample had no position for EventRule close; the last: x of van1 is absent",
        )


def harms_nobody(chain: Chain, vehicles: Vehicles, bad: Callable[[], bytes], *logged: str) -> None:
    """One vehicle of another pair sends only bad poses for a while: this is logged, and that episode stays open."""
    running = chain.start()
    with unharmed(chain, vehicles, running):
        vehicles.place(VANS, NEAR)
        deployed = chain.wait_deployed(VANS)
        vehicles.instead("van1", bad)
        for line in logged:
            running.wait_for_output(line)
        vehicles.place(BUSES, NEAR)  # once their Deployment exists, the bad poses have been evaluated many times
        chain.wait_deployed(BUSES)
        assert untouched(deployed, chain.deployment(VANS)), "no episode ends while a position is unknown"
        vehicles.instead("van1", None)
        vehicles.place(VANS, FAR)
        chain.wait_events(VANS, "started", "Until")


def test_with_clock_data_a_client_whose_clock_is_ahead_affects_no_other_client(chain: Chain) -> None:
    spec = {"streams": [cdr_stream()], "clock": "Data", "lateness": "300ms"}
    chain.apply(rule(position="msg.pose.position"), detector(chain.endpoint, **spec))
    running = chain.start()

    def from_the_future() -> bytes:
        return cdr(pose_stamped(0.0, 0.0, seconds=int(time.time()) + HOUR, nanoseconds=0))

    with Vehicles(chain.endpoint, cdr_pose) as vehicles, unharmed(chain, vehicles, running):
        vehicles.place(VANS, NEAR)
        chain.wait_events(VANS, "started")
        vehicles.instead("van1", from_the_future)
        running.wait_for_output(
            r"because their stamps are ahead of the rest; the last: van1 is 3[56]\d\d(\.\d+)? s ahead"
        )
        vehicles.place(BUSES, NEAR)  # the stamps of the others advance the time
        chain.wait_events(BUSES, "started")


SPEED = {"name": "speed", "stream": "odometrie", "value": "msg.v"}
BAD_RULES = {
    "syntax": (rule("syntax", when="distance <"), r"spec\.when: "),
    "type": (rule("type", when="distance + 1"), r"spec\.when: .*boolean"),
    "mixed-types": (rule("mixed-types", when='distance < "150"'), r"spec\.when: "),
    "unknown-name": (rule("unknown-name", when="distanse < 150"), r"spec\.when: .*distance"),
    "unknown-stream": (
        rule("unknown-stream", signals=[SPEED], when="a.speed > b.speed"),
        r"spec\.signals\[0\]\.stream: .*odometrie.*pose",
    ),
    "parameter": (
        rule("parameter", actions=recording(rate="${distanse}")),
        r"spec\.actions\[0\]\.deploy\.parameters\S*: ",
    ),
}


def test_rules_that_do_not_compile_are_rejected_and_the_others_run(chain: Chain) -> None:
    chain.apply(rule(), detector(chain.endpoint))
    running = chain.start()
    with Vehicles(chain.endpoint) as vehicles, unharmed(chain, vehicles, running):
        chain.apply(*(bad for bad, _ in BAD_RULES.values()))
        for name, (_, logged) in BAD_RULES.items():
            running.wait_for_output(f"EventRule {name} is refused: {logged}")
            assert re.search(logged, chain.wait_condition("EventRule", name, "Accepted", "False")["message"])
        assert chain.wait_condition("EventRule", "close", "Accepted", "True")
        vehicles.place(VANS, NEAR)
        chain.wait_deployed(VANS)
        assert chain.live() == {"+".join(CARS), "+".join(VANS)}
        chain.apply(rule("syntax", when="distance < 150", actions=[]))
        assert chain.wait_condition("EventRule", "syntax", "Accepted", "True")


def test_detector_check_reports_where_each_rule_is_wrong(tmp_path: Path) -> None:
    good = [detector("tcp/127.0.0.1:7447"), rule()]
    (tmp_path / "good.yaml").write_text(yaml.safe_dump_all(good), encoding="utf-8")
    for name, (bad, _) in BAD_RULES.items():
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(bad), encoding="utf-8")
    checked = command("check", ".", folder=tmp_path)
    assert checked.returncode == 1
    assert len(checked.stderr.splitlines()) == len(BAD_RULES), checked.stderr
    for name, (_, logged) in BAD_RULES.items():
        assert re.search(rf"^{name}\.yaml:\d+:\d+: {logged}", checked.stderr, re.MULTILINE), checked.stderr


def test_a_rule_that_names_a_missing_template_has_a_task_that_reports_it(chain: Chain) -> None:
    missing = [{"name": "record", "deploy": {"templateName": "recordr", "parameters": {}}}]
    chain.apply(rule(), of_vans(missing), detector(chain.endpoint))
    running = chain.start(rules=2)
    with Vehicles(chain.endpoint) as vehicles, unharmed(chain, vehicles, running):
        vehicles.place(VANS, NEAR)
        chain.wait_deployed(VANS)
        reported = refusal(chain, "bad")
        assert reported["reason"] == "TemplateNotFound"
        assert "recordr" in reported["message"]
        assert len(chain.api.list("Deployment")) == 2


def of_vans(actions: list[Object]) -> Object:
    """Another rule, whose subjects exclude the well-behaved pair."""
    bad = rule("bad", actions=actions)
    bad["spec"]["scope"]["pairs"]["where"] = f"a.client == '{VANS[0]}'"
    return bad


def refusal(chain: Chain, of_rule: str) -> Object:
    """The condition Accepted=False of a task that the rule's action emitted."""

    def refused(tasks: list[Object]) -> list[Object]:
        conditions = [condition(task, "Accepted") for task in tasks if task["spec"]["event"]["rule"] == of_rule]
        return [each for each in conditions if each.get("status") == "False"]

    tasks = chain.api.wait_list("ApplicationTask", lambda tasks: bool(refused(tasks)), what="the task is rejected")
    return refused(tasks)[0]


@pytest.mark.parametrize(
    ("arguments", "logged"),
    [
        (["run"], "give either --detector FILE and --rules FILE, or --name NAME"),
        (["run", "--name", HOLDER, "--rules", "rules.yaml"], "--rules requires --detector"),
        (["run", "--detector", "nowhere.yaml"], "nowhere.yaml"),
        (["replay", "nowhere.mcap", "--output", "out"], "give --detector FILE and --rules FILE"),
        (["chek"], "No such command"),
    ],
    ids=["nothing", "both", "no-detector", "no-recording", "command"],
)
def test_a_usage_error_is_one_line_and_exit_code_2(tmp_path: Path, arguments: list[str], logged: str) -> None:
    done = command(*arguments, folder=tmp_path)
    assert done.returncode == 2
    assert logged in done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert not done.stdout


def test_a_detector_missing_in_the_cluster_is_reported_and_waited_for(chain: Chain) -> None:
    running = chain.processes.start("detector", "run", "--name", HOLDER, "--namespace", chain.namespace)
    running.wait_for_output(f"there is no Detector '{HOLDER}' in namespace {chain.namespace}: create it")
    chain.apply(rule(), detector(chain.endpoint))
    running.wait_for_output(f"Detector {HOLDER} runs with 1 rules")
    assert running.terminate() == 0


def command(*arguments: str, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run `detector` to its end, without a cluster."""
    return programs.run("detector", *arguments, environment={"KUBECONFIG": os.devnull}, folder=folder)
