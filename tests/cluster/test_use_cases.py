"""The use cases that deploy or reconfigure, on a real control plane: the applications at each moment of the scenario.

The scenario is played to a running detector over Zenoh, up to a moment; then time stands still (`clock: Data`) until
the cluster matches the scenario's own truth. So the speed of the machine does not matter: an overloaded detector skips
evaluations of the rules of lowest priority, which are spare ones here. If messages do not contain the whole time, as
with CAM, the clock advances, but nobody sends anything: nothing starts or ends while all is unknown.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml
import zenoh

from application_manager.core.claims.claims import instance_name
from examples.running.cases import folder_of, scenario_of, use_cases
from examples.running.demanding import RunningTask, consists_of, unlike
from examples.running.scenario import SECOND, Message, Moment
from tests.cluster.api import Api
from tests.cluster.expected_objects import condition, start_manager, wait_settled
from tests.cluster.processes import Processes
from tests.cluster.repeating import repeated
from tests.cluster.waiting import INTERVAL, wait_until
from tests.networks import session
from tests.patience import PATIENCE
from tests.ports import free_endpoint

PACE = 2.5  # times real time
STEP_NS = SECOND // 20  # messages published at once
DATA = {"clock": "Data", "lateness": "100ms"}
SPARE = (-3, -2, -1)  # priorities: three levels of overload each
WALL = {"clock": "Wall", "clientTimeout": "30m"}  # no client is lost while the test waits for the cluster


@pytest.mark.parametrize("name", [each for each in use_cases() if scenario_of(each).moments])
def test_the_running_applications_match_the_scenario(
    name: str, api: Api, namespace: str, processes: Processes, tmp_path: Path
) -> None:
    endpoint = free_endpoint()
    scenario = scenario_of(name)
    clock = WALL if scenario.real_time else DATA
    holder = apply_use_case(api, name, endpoint, tmp_path, clock)
    start_manager(processes, namespace)
    detector = processes.start("detector", "run", "--name", holder, "--namespace", namespace)
    detector.wait_for_output(f"Detector {holder} runs with")
    messages = sorted(scenario.messages(), key=lambda each: (each.after_ns, each.key))
    assert len(scenario.moments) >= 2
    with Player(endpoint, messages, 1.0 if scenario.real_time else PACE).playing() as player:
        for moment in scenario.moments:
            player.play_until(moment.at_s)
            wait_runs(api, moment)
            wait_settled(api)
    assert detector.terminate() == 0


@pytest.mark.usefixtures("kubelet")
def test_a_vehicle_is_never_without_its_application_while_that_moves_to_the_edge(
    api: Api, namespace: str, processes: Processes, tmp_path: Path
) -> None:
    """In each list one of the two places serves, so the old instance is removed only after the new one is ready."""
    name, cloud, edge = "edge-offloading", "car-1-cloud", "car-1-edge"
    scenario = scenario_of(name)
    endpoint = free_endpoint()
    holder = apply_use_case(api, name, endpoint, tmp_path, DATA)
    # This is promised only for a linger longer than a start: here long enough for a slow machine.
    api.patch("ApplicationTemplate", "vision", {"spec": {"lifecycle": {"linger": "20s"}}})
    start_manager(processes, namespace)
    detector = processes.start("detector", "run", "--name", holder, "--namespace", namespace)
    detector.wait_for_output(f"Detector {holder} runs with")
    before, after = (next(each for each in scenario.moments if each.at_s == at) for at in (10.0, 25.0))
    assert {f"vision/{cloud}", f"vision/{edge}"} == {*before.runs} ^ {*after.runs}
    messages = sorted(scenario.messages(), key=lambda each: (each.after_ns, each.key))
    with Player(endpoint, messages, PACE).playing() as player:
        player.play_until(before.at_s)
        wait_until(lambda: places(api, cloud, edge), lambda there: there == {cloud: True}, what="the cloud serves")
        with looking(lambda: places(api, cloud, edge)) as seen:
            player.play_until(after.at_s)
            wait_runs(api, after)
            wait_until(
                lambda: places(api, cloud, edge), lambda there: there == {edge: True}, what="only the edge serves"
            )
    assert [each for each in seen if not any(each.values())] == []
    assert seen[0] == {cloud: True}
    assert {cloud: True, edge: True} in seen
    assert seen[-1] == {edge: True}
    assert detector.terminate() == 0


def places(api: Api, *keys: str) -> dict[str, bool]:
    """Which of the instances of `vision` with these keys have a Deployment, and whether a pod of it serves."""
    names = {instance_name("vision", key): key for key in keys}
    return {
        names[each["metadata"]["name"]]: each.get("status", {}).get("availableReplicas", 0) > 0
        for each in api.list("Deployment")
        if each["metadata"]["name"] in names and "deletionTimestamp" not in each["metadata"]
    }


@contextmanager
def looking(look: Callable[[], dict[str, bool]]) -> Iterator[list[dict[str, bool]]]:
    """Read the state repeatedly for the duration of a `with` block; keep each state that differs from the last."""
    seen: list[dict[str, bool]] = []

    def keep() -> None:
        found = look()
        if not seen or found != seen[-1]:
            seen.append(found)

    with repeated("looking", keep, INTERVAL):
        yield seen


def apply_use_case(api: Api, name: str, endpoint: str, folder: Path, clock: dict[str, str]) -> str:
    """Apply the use case's own files with another endpoint, folder and clock; return the holder's name."""
    holder, labels = "", {}
    for file in ("templates.yaml", "rules.yaml", "detector.yaml"):
        for document in yaml.safe_load_all((folder_of(name) / file).read_text(encoding="utf-8")):
            document["metadata"]["namespace"] = api.namespace
            if document["kind"] == "Detector":
                holder = document["metadata"]["name"]
                spec = document["spec"]
                spec |= {"zenoh": {"mode": "peer", "listen": [endpoint]}, **clock}
                if "recordings" in spec:
                    spec["recordings"]["path"] = str(folder / "recordings")
            elif document["kind"] == "EventRule":
                labels = document["metadata"]["labels"]
            api.apply(document)
    for priority in SPARE:
        metadata = {"name": f"spare{priority}", "namespace": api.namespace, "labels": labels}
        spec = {"when": "false", "evaluation": {"priority": priority}}
        api.apply({"apiVersion": "wayside.dev/v1alpha1", "kind": "EventRule", "metadata": metadata, "spec": spec})
    return holder


def wait_runs(api: Api, moment: Moment) -> None:
    """Wait until exactly the expected applications run, with the expected configuration."""
    wait_until(
        lambda: list(unlike(moment, running(api))),
        lambda problems: not problems,
        what=f"the expected applications run at {moment.at_s:g} s",
    )


def running(api: Api) -> dict[str, RunningTask]:
    """The applications in the namespace, by template and key."""
    found = {}
    for instance in api.list("ApplicationInstance"):
        spec, status = instance["spec"], instance.get("status", {})
        objects = [api.find(each["kind"], each["name"]) for each in status.get("objects", ())]
        there = [each for each in objects if each is not None]
        replicas = [each["spec"]["replicas"] for each in there if each["kind"] == "Deployment"]
        suspended = condition(instance, "Suspended").get("status") == "True" and not any(replicas)
        found[f"{spec['templateName']}/{spec.get('key', '')}"] = consists_of(there, suspended=suspended)
    return found


class Player:
    """Publishes a scenario's messages in order, up to a given time, slightly faster than real time.

    Not at full speed: an overloaded detector skips evaluations.
    """

    def __init__(self, endpoint: str, messages: list[Message], pace: float) -> None:
        self._endpoint = endpoint
        self._pace = pace
        self._messages = messages
        self._next = 0
        self._pause_ns = 0
        self._publishers: dict[str, zenoh.Publisher] = {}

    @contextmanager
    def playing(self) -> Iterator[Player]:
        """For the duration of the block, a subscriber receives all keys."""
        there = session(
            "peer",
            connect__endpoints=[self._endpoint],
            connect__timeout_ms=round(PATIENCE * 1000),
            connect__exit_on_failure=True,
            listen__endpoints=[],
        )
        with there:
            for key in dict.fromkeys(each.key for each in self._messages):
                self._publishers[key] = there.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
            wait_until(
                lambda: [key for key, each in self._publishers.items() if not each.matching_status.matching],
                lambda alone: not alone,
                what="the detector subscribes to all keys",
            )
            yield self

    def play_until(self, at_s: float) -> None:
        """Publish all messages up to this second."""
        while self._next < len(self._messages) and self._messages[self._next].after_ns <= at_s * SECOND:
            message = self._messages[self._next]
            if message.after_ns >= self._pause_ns:
                self._pause_ns = message.after_ns + STEP_NS
                time.sleep(STEP_NS / SECOND / self._pace)
            self._publishers[message.key].put(message.payload)
            self._next += 1
