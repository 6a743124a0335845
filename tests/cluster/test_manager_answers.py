"""The columns of kubectl and `application-manager explain` show why something runs, or does not."""

from __future__ import annotations

import json
import subprocess
from typing import Any

from application_manager.core.claims.claims import instance_name
from tests import programs
from tests.cluster.api import Api, Object
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import start_manager, task, template, wait_settled
from tests.cluster.pods import mark_pods_ready
from tests.cluster.processes import Process, Processes
from tests.cluster.waiting import wait_until

NORTH = instance_name("app", "north")
RATED = {
    "parameters": {"region": {"type": "string"}, "rate": {"type": "number", "merge": "Max", "default": 1}},
}


def emitted(name: str, **parameters: Any) -> Object:
    made = task(name, holder="town", **parameters)
    times = dict.fromkeys(("onsetTime", "startTime"), "2026-01-02T03:04:05Z")
    event = {"id": "e", "rule": "scene", "action": "fuse", "subject": "car1", "values": {"distance": 7}, **times}
    made["spec"]["event"] = event
    made["spec"]["requester"]["detectorName"] = "town"
    return made


def columns(control_plane: ControlPlane, api: Api, what: str, name: str) -> dict[str, str]:
    """A row of `kubectl get` by its header; a cell extends to the next heading."""
    header, row = control_plane.kubectl("get", what, name, "--namespace", api.namespace).splitlines()
    starts = [
        (index, header[index:].split()[0])
        for index in range(len(header))
        if header[index] != " " and header[index - 1 : index] in ("", " ")
    ]
    ends = [start for start, _ in starts[1:]] + [len(row)]
    return {heading: row[start:end].strip() for (start, heading), end in zip(starts, ends, strict=True)}


def explain(control_plane: ControlPlane, api: Api, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {"KUBECONFIG": str(control_plane.kubeconfig)}
    return programs.run("application-manager", "explain", *arguments, "-n", api.namespace, environment=environment)


def wait_column(control_plane: ControlPlane, api: Api, what: str, name: str, **cells: str) -> None:
    wait_until(
        lambda: columns(control_plane, api, what, name),
        lambda row: all(text in row.get(heading, "") for heading, text in cells.items()),
        what=f"{what} {name} shows {cells}",
    )


def test_columns_show_demanded_running_and_missing_applications(
    control_plane: ControlPlane, api: Api, manager: Process
) -> None:
    api.create(template(**RATED, linger="300s"))
    api.create(emitted("one", region="north"))
    api.create(task("wrong", region="north", rate="fast"))
    wait_column(control_plane, api, "apptask", "one", RULE="scene", SUBJECT="car1", INSTANCE=NORTH, PHASE="Active")
    wait_column(control_plane, api, "apptask", "one", MESSAGE=f"instance {NORTH} is not ready yet")
    wait_column(control_plane, api, "apptask", "wrong", PHASE="Refused", MESSAGE="'fast' is not of type number")
    wait_column(control_plane, api, "appinst", NORTH, KEY="north", DEMANDS="1", READY="False", PHASE="Applied")
    wait_column(control_plane, api, "appinst", NORTH, MESSAGE="has 0 of 1 pods available")
    wait_until(lambda: mark_pods_ready(api), bool, what="the pod exists")
    wait_column(control_plane, api, "apptask", "one", PHASE="Ready")
    assert columns(control_plane, api, "apptask", "one")["MESSAGE"] == ""
    api.delete("ApplicationTask", "one")
    wait_column(control_plane, api, "appinst", NORTH, PHASE="Lingering", MESSAGE="unless a demand arrives")
    api.create({**template("other"), "spec": {"manifests": [{"apiVersion": "v1", "kind": "Role", "metadata": {}}]}})
    wait_column(control_plane, api, "apptpl", "other", READY="False", MESSAGE="spec.manifests[0].kind")


def test_explain_goes_from_the_event_over_merged_values_to_the_pods(
    control_plane: ControlPlane, api: Api, manager: Process
) -> None:
    api.create(template(**RATED))
    api.create(emitted("one", region="north", rate=5))
    api.create(task("two", region="north", rate=9))
    api.wait_for(
        "ApplicationInstance", NORTH, lambda raw: raw["spec"]["parameters"].get("rate") == 9, what="both are merged"
    )
    wait_settled(api)
    pods = api.wait_list("Pod", lambda found: len(found) == 1, what="the pod exists")
    reported = wait_until(
        lambda: explain(control_plane, api, "one").stdout,
        lambda text: f"Deployment {NORTH} has 0 of 1 pods available" in text,
        what="the manager has written what belongs to the instance",
    )
    for line in (
        "event: scene of car1, started 2026-01-02T03:04:05Z",
        "distance = 7",
        "requested by detector town, holder town",
        "rate = 9 (merge Max)",
        "5 of one (car1) is overridden: a larger value counts",
        "9 of two is used",
        f"{pods[0]['metadata']['name']} Pending: not ready yet",
    ):
        assert line in reported
    as_json = json.loads(explain(control_plane, api, f"appinst/{NORTH}", "-o", "json").stdout)
    assert [each["name"] for each in as_json["tasks"]] == ["one", "two"]
    assert as_json["instance"]["phase"] == "Applied"
    assert "task" not in as_json


def test_an_explain_error_is_one_line_with_the_remedy(control_plane: ControlPlane, api: Api) -> None:
    failed = explain(control_plane, api, "nothing")
    assert (failed.returncode, failed.stdout) == (2, "")
    assert "there is no ApplicationTask or ApplicationInstance 'nothing'" in failed.stderr
    assert len(failed.stderr.splitlines()) == 1
    api.create(task("waits", of="missing"))
    reported = explain(control_plane, api, "waits").stdout
    assert "template missing: does not exist" in reported
    assert "the manager has not processed its current generation" in reported


def test_explain_reports_instances_without_a_place_and_fallbacks(
    control_plane: ControlPlane, api: Api, processes: Processes, namespace: str
) -> None:
    start_manager(processes, namespace, "--max-instances", "2")
    instead = instance_name("lite", "north")
    in_time = {"linger": "1s", "readyTimeout": "1s", "fallback": {"templateName": "lite"}}
    api.create(template("lite"))
    api.create(template(lifecycle=in_time))
    api.create(task("north"))
    api.wait_for(
        "ApplicationTask", "north", lambda raw: raw.get("status", {}).get("instanceName") == instead, what="served"
    )
    api.create(task("south", of="lite"))
    api.wait_for("ApplicationTask", "south", lambda raw: raw.get("status", {}).get("phase") == "Waiting", what="waits")

    north = explain(control_plane, api, "task/north").stdout
    assert f"FallenBack: instance {NORTH} is not ready; until it is, instance {instead} of template lite" in north
    assert "\ntemplate app\n" in north
    assert f"\ninstance {instead} of template lite (" in north
    assert '"north" of north is used' in north
    south = explain(control_plane, api, "task/south").stdout
    assert "Waiting, LimitReached: " in south
    assert "the namespace is at its limit of 2 instances" in south
    its = explain(control_plane, api, f"instance/{instead}").stdout
    assert f"template lite\ninstance {instead} (" in its
    assert f"tasks of instance {instead}\n  north (by a person, Deploy, priority 0) Counts\n" in its
