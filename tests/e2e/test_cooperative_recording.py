"""The cooperative-recording example on a real node: both programs and the applications run in pods."""

from __future__ import annotations

import sys
from collections.abc import Callable

import yaml

from tests.cluster.api import Api, Objects
from tests.cluster.waiting import wait_until
from tests.e2e.node import Node
from tests.e2e.wayside_in_cluster import EXAMPLE, apply_example, run_town
from tests.patience import NODE_PATIENCE

sys.path.insert(0, str(EXAMPLE))

from cooperative_recording.parked import ParkedVehicles
from cooperative_recording.vehicles import LIDAR_VEHICLES

REPORT = """
import pathlib, sys, time
print("#", *sys.argv[1:], flush=True)
paths = [pathlib.Path(a.split("=", 1)[1]) for a in sys.argv if a.startswith("--configuration=")]
last = None
while True:
    text = "".join(path.read_text() for path in paths)
    if text != last:
        print("---", text, sep="\\n", flush=True)
        last = text
    time.sleep(0.1)
"""
"""The program of each application: it prints its arguments, and its configuration at each change."""


def applications(api: Api, name: str) -> Objects:
    return api.list("Pod", labels=f"app.kubernetes.io/name={name}")


def ready(pods: Objects) -> bool:
    conditions = [{each["type"]: each["status"] for each in pod["status"].get("conditions", [])} for pod in pods]
    return len(pods) == 1 and all(each.get("Ready") == "True" for each in conditions)


def wait_pods(api: Api, name: str, holds: Callable[[Objects], bool], what: str) -> Objects:
    return wait_until(lambda: applications(api, name), holds, timeout=NODE_PATIENCE, what=what)


def test_applications_really_run_while_vehicles_are_close_follow_who_joins_and_are_gone_after(
    node: Node, api: Api, image: str
) -> None:
    first, second, third = (vehicle.name for vehicle in LIDAR_VEHICLES[:3])
    apply_example(api, image, ["python3", "-c", REPORT])
    port = run_town(api, image)
    with ParkedVehicles([f"tcp/{node.address}:{port}"], wait_s=NODE_PATIENCE) as vehicles:
        vehicles.put(first, 0)
        vehicles.put(second, 100)

        (recorder,) = wait_pods(api, "scene-recorder", ready, "the recorder of the two runs")
        (fusion,) = wait_pods(api, "scene-fusion", ready, "the fusion of their scene runs")

        def logged(pod: str) -> str:
            log = ("--namespace", api.namespace, "logs", pod)
            return wait_until(lambda: node.plane.kubectl(*log), bool, what=f"pod {pod} has written")

        def configurations() -> list[list[str]]:
            """The sources in each configuration that the fusion received, in order."""
            documents = yaml.safe_load_all(logged(fusion["metadata"]["name"]))
            return [yaml.safe_load(str(each["sources"])) for each in documents if each]

        reported = logged(recorder["metadata"]["name"])
        assert f"--key=vehicles/{first}/** --key=vehicles/{second}/** --output=/recording" in reported
        # The log may end between a heading and its configuration.
        written = wait_until(
            configurations,
            bool,
            timeout=NODE_PATIENCE,
            what="the fusion receives the sources",
            transient=(yaml.YAMLError, TypeError, KeyError),
        )
        assert written == [sorted([first, second])]
        tasks = api.wait_list(
            "ApplicationTask",
            lambda found: len(found) == 2 and all(each.get("status", {}).get("phase") == "Ready" for each in found),
            what="both tasks are Ready",
        )
        assert {task["spec"]["requester"]["holder"] for task in tasks} == {"town"}

        vehicles.put(third, 200)

        everybody = sorted([first, second, third])
        wait_until(
            configurations,
            lambda found: found[-1] == everybody,
            timeout=NODE_PATIENCE,
            what="the fusion receives all sources",
            transient=(yaml.YAMLError, TypeError, KeyError),
        )
        (same,) = applications(api, "scene-fusion")
        assert same["metadata"]["uid"] == fusion["metadata"]["uid"]
        assert same["status"]["containerStatuses"][0]["restartCount"] == 0

        vehicles.put(third, 2000)
        vehicles.put(second, 1000)

        wait_pods(api, "scene-recorder", lambda pods: not pods, "the recorder is removed")
        wait_pods(api, "scene-fusion", lambda pods: not pods, "the fusion is removed")
    pods = [
        pod for each in ("app=application-manager", "wayside.dev/runs=town") for pod in api.list("Pod", labels=each)
    ]
    restarts = [status["restartCount"] for pod in pods for status in pod["status"]["containerStatuses"]]
    assert restarts == [0, 0]
