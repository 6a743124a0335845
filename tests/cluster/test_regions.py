"""Three regions with a detector each: a vehicle that crosses their borders keeps its application."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import msgspec
import pytest
import yaml

from detector.status.total import Total
from examples.regions.drive import area, message
from tests import programs
from tests.cluster.api import Api, Object
from tests.cluster.expected_objects import start_manager, wait_settled
from tests.cluster.processes import Processes
from tests.cluster.waiting import wait_until
from tests.guides import guide, yaml_blocks
from tests.helm import ensure_tools
from tests.helm.wayside_chart import Helm, HelmError
from tests.networks import router, session
from tests.patience import PATIENCE
from tests.ports import free_endpoint
from wayside.api import ApplicationTemplate

EXAMPLE = Path(__file__).parents[2] / "examples" / "regions"
REGIONS = ("north", "center", "south")


class Road:
    """Publishes a vehicle that requests assistance and one that does not, at the positions that the test sets."""

    def __init__(self, endpoint: str) -> None:
        self.x = 500.0
        self._session = session(connect__endpoints=[endpoint])
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.wait(0.1):
            for vehicle, x, assistance in (("car-1", self.x, True), ("car-2", 1500.0, False)):
                key, content = message(vehicle, x, assistance)
                self._session.put(key, json.dumps(content))

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._session.close()  # type: ignore[no-untyped-call]


def documents(file: str, endpoint: str) -> list[Object]:
    text = (EXAMPLE / file).read_text().replace("tcp/zenoh:7447", endpoint)
    return [each for each in yaml.safe_load_all(text) if each]


def wait_demands(api: Api, *regions: str) -> list[Object]:
    """Wait until the live tasks are those of these regions; all are of one instance."""

    def live(tasks: list[Object]) -> list[Object]:
        return [each for each in tasks if "endTime" not in each["spec"]]

    wanted = sorted(f"town-{region}" for region in regions)
    tasks = live(
        api.wait_list(
            "ApplicationTask",
            lambda found: sorted(each["spec"]["requester"]["holder"] for each in live(found)) == wanted,
            what=f"the demands are those of {regions}",
        )
    )
    assert {each["spec"]["event"]["subject"] for each in tasks} == {"car-1"}
    return tasks


def wait_application(api: Api, where: str) -> tuple[Object, Object, list[Object]]:
    """Wait until the application's configuration has only this area; return its instance, Deployment and pods."""
    (instance,) = api.wait_list(
        "ApplicationInstance",
        lambda found: [each["spec"]["parameters"].get("areas") for each in found] == [[where]],
        what=f"the only instance has the areas [{where}]",
    )
    api.wait_list(
        "ConfigMap",
        lambda found: [yaml.safe_load(it["data"]["assistant.yaml"])["areas"] for it in found] == [[where]],
        labels="app.kubernetes.io/managed-by=wayside",
        what=f"the application's configuration names {where}",
    )
    (deployment,) = api.wait_list("Deployment", lambda found: len(found) == 1, what="exactly one Deployment exists")
    pods = api.wait_list("Pod", lambda found: len(found) == 1, what="exactly one pod exists")
    return instance, deployment, pods


def test_the_chart_makes_the_detectors_of_the_example(tmp_path: Path) -> None:
    helm = Helm(ensure_tools().helm, tmp_path / "helm")
    rendered = helm.rendered(yaml.safe_load((EXAMPLE / "helm" / "values.yaml").read_text()))
    written = yaml.safe_load_all((EXAMPLE / "detectors.yaml").read_text())
    assert {each["metadata"]["name"]: each["spec"] for each in rendered.of("Detector")} == {
        each["metadata"]["name"]: each["spec"] | {"mode": "Standalone"} for each in written
    }


def test_a_region_of_the_guide_has_its_own_name_address_and_spec(tmp_path: Path) -> None:
    helm = Helm(ensure_tools().helm, tmp_path / "helm")
    values, template = map(yaml.safe_load, yaml_blocks(guide("regions")))
    ApplicationTemplate.model_validate(template)
    (town,) = values["detectors"]
    service = {"ports": [7447], "annotations": {"dns": "{region}.town.example"}}
    rendered = helm.rendered({"detectors": [town | {"service": service}]})
    specs = {each["metadata"]["name"]: each["spec"] for each in rendered.of("Detector")}
    assert {name: spec["zenoh"]["connect"] for name, spec in specs.items()} == {
        f"town-{region}": [f"tcp/router-{region}:7447"] for region in REGIONS
    }
    assert [name for name, spec in specs.items() if "pod" in spec] == ["town-center"]
    annotated = {each["metadata"]["name"]: each["metadata"].get("annotations") for each in rendered.of("Service")}
    policies = {each["metadata"]["name"] for each in rendered.of("NetworkPolicy")}
    for region in REGIONS:
        assert annotated[f"wayside-detector-town-{region}"] == {"dns": f"{region}.town.example"}
        assert f"wayside-detector-town-{region}" in policies
    town["spec"]["streams"][0]["key"] = "town/*/${client:*}/state"
    with pytest.raises(HelmError, match=r"the regions north and center have the same streams.*write \{region\} into"):
        helm.rendered({"detectors": [town]})


@pytest.mark.usefixtures("kubelet")
def test_a_vehicle_that_crosses_borders_keeps_its_application(
    api: Api, namespace: str, processes: Processes, tmp_path: Path
) -> None:
    endpoint = free_endpoint()
    network = router(listen__endpoints=[endpoint])
    for file in ("templates.yaml", "rules.yaml", "detectors.yaml"):
        for each in documents(file, endpoint):
            api.apply({**each, "metadata": {**each["metadata"], "namespace": namespace}})
    start_manager(processes, namespace)
    outputs = {region: tmp_path / region for region in REGIONS}
    for region, output in outputs.items():
        options = ("--name", f"town-{region}", "--namespace", namespace, "--output", str(output))
        processes.start("detector", "run", *options, name=region)
    road = Road(endpoint)
    try:
        wait_demands(api, "north")
        first = wait_application(api, "north")
        for x, regions in (
            (1000.0, ("north", "center")),
            (1500.0, ("center",)),
            (2000.0, ("center", "south")),
            (2500.0, ("south",)),
        ):
            road.x = x
            tasks = wait_demands(api, *regions)
            later = wait_application(api, area(x))
            assert {each["spec"]["parameters"]["vehicle"] for each in tasks} == {"car-1"}
            for before, after in zip(first[:2], later[:2], strict=True):
                assert after["metadata"]["uid"] == before["metadata"]["uid"], f"another {after['kind']} at {x} m"
            assert later[1]["metadata"]["generation"] == first[1]["metadata"]["generation"], (
                "the Deployment was changed"
            )
            assert [it["metadata"]["uid"] for it in later[2]] == [it["metadata"]["uid"] for it in first[2]]
            if len(regions) == 2:
                wait_seen_twice(tmp_path, endpoint)
        wait_settled(api)
        for region, output in outputs.items():
            wait_until(
                lambda file=output / "events.jsonl": {
                    json.loads(line)["subject"] for line in file.read_text().splitlines(True) if line.endswith("\n")
                },
                lambda subjects: subjects == {"car-1"},
                what=f"the detector of {region} has reported an episode of its own",
            )
    finally:
        road.close()
        processes.kill_all()
        network.close()  # type: ignore[no-untyped-call]


def wait_seen_twice(folder: Path, endpoint: str) -> None:
    """Wait until `detector status --all` adds up three detectors, of which two see the vehicle."""
    file = folder / "detectors.yaml"
    file.write_text((EXAMPLE / "detectors.yaml").read_text().replace("tcp/zenoh:7447", endpoint))

    def requested() -> Total:
        words = ("status", "--all", "--detector", str(file), "--timeout", str(PATIENCE / 4), "--json")
        return msgspec.json.decode(programs.run("detector", *words, check=True).stdout, type=Total)

    found = wait_until(
        requested,
        lambda it: (it.shared_clients, [each.open for each in it.rules], it.demand_count) == (["car-1"], [2], 2),
        what="two detectors see the vehicle, its episode and its demand",
    )
    assert [each.holder for each in found.detectors] == ["town-center", "town-north", "town-south"]
