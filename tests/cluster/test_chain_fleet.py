"""Rules over the fleet with `follow`: clients that appear and leave change the instance through one task each."""

from __future__ import annotations

import json
from pathlib import Path

from tests.cluster.api import Api, Object, Objects
from tests.cluster.chain import CARS, FAR, NEAR, VANS, Chain, Vehicles, detector, rule, untouched
from tests.cluster.processes import Processes

SITES = {"as": "site", "of": [{"name": "north", "y": 0}, {"name": "south", "y": 10_000}]}
"""The sites that the cars and the vans pass."""


def fusion() -> Object:
    """A template of one instance for each region; its sources are in a ConfigMap, so they need no rollout."""
    labels = {"region": "${parameters.region}"}
    deployment = {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {"name": "${instance.name}", "labels": labels},
        "spec": {
            "replicas": 1,
            "selector": {"matchLabels": labels},
            "template": {
                "metadata": {"labels": labels},
                "spec": {"containers": [{"name": "main", "image": "app:1"}]},
            },
        },
    }
    config = {
        "apiVersion": "v1",
        "kind": "ConfigMap",
        "metadata": {"name": "${instance.name}", "labels": labels},
        "data": {"sources": "these: ${parameters.sources}"},
    }
    return {
        "apiVersion": "wayside.dev/v1alpha1",
        "kind": "ApplicationTemplate",
        "metadata": {"name": "fusion"},
        "spec": {
            "parameters": {
                "region": {"type": "string", "required": True, "merge": "Same"},
                "sources": {"type": "array", "items": "string", "merge": "Union"},
            },
            "key": "${parameters.region}",
            "manifests": [deployment, config],
        },
    }


def seen_at_a_site() -> Object:
    parameters = {"region": "${site.name}", "sources": "${members.map(m, m.client)}"}
    return rule(
        "seen",
        scope={"fleet": {"members": "y == site.y && x < 200.0"}},
        each=SITES,
        signals=[{"name": axis, "stream": "pose", "value": f"msg.{axis}"} for axis in ("x", "y")],
        when="size(members) > 0",
        until="size(members) == 0",
        actions=[{"name": "fuse", "deploy": {"templateName": "fusion", "follow": True, "parameters": parameters}}],
    )


def wait_sources(api: Api, region: str, sources: list[str]) -> tuple[Object, Object, Object]:
    """Wait until one task of the region has these sources; return it with its instance and Deployment."""

    def one_with_them(found: Objects) -> bool:
        return [each["spec"]["parameters"].get("sources") for each in of_region(found)] == [sources]

    def of_region(found: Objects) -> Objects:
        return [each for each in found if each["spec"]["parameters"]["region"] == region]

    (task,) = of_region(api.wait_list("ApplicationTask", one_with_them, what=f"the task of {region} has {sources}"))
    (instance,) = of_region(
        api.wait_list("ApplicationInstance", one_with_them, what=f"the instance of {region} has {sources}")
    )
    api.wait_list(
        "ConfigMap",
        lambda found: [json.loads(each["data"]["sources"].removeprefix("these: ")) for each in found] == [sources],
        labels=f"region={region}",
        what=f"the application of {region} receives {sources}",
    )
    (deployment,) = api.wait_list(  # created after the ConfigMap
        "Deployment",
        lambda found: len(found) == 1,
        labels=f"region={region}",
        what=f"the application of {region} exists",
    )
    return task, instance, deployment


def test_sources_that_come_and_go_reach_the_instance_of_each_site_without_a_restart(
    api: Api, namespace: str, processes: Processes, tmp_path: Path
) -> None:
    chain = Chain(api, namespace, processes, tmp_path / "out")
    unhurried = detector(chain.endpoint)
    unhurried["spec"]["streams"][0]["staleAfter"] = "Never"  # a pausing vehicle would be lost and return
    chain.apply(fusion(), seen_at_a_site(), unhurried)
    chain.start()
    with Vehicles(chain.endpoint) as vehicles:
        vehicles.place(CARS, NEAR)
        vehicles.place(VANS, FAR)
        first = wait_sources(api, "north", ["car1", "car2"])
        other = wait_sources(api, "south", ["van1"])
        assert first[0]["spec"]["event"]["subject"] == "~fleet~north"
        vehicles.place(CARS, FAR)
        fewer = wait_sources(api, "north", ["car1"])
        vehicles.place(CARS, NEAR)
        again = wait_sources(api, "north", ["car1", "car2"])
        for later in (fewer, again):
            assert [each["metadata"]["uid"] for each in later] == [each["metadata"]["uid"] for each in first]
            assert untouched(first[2], later[2]), "the application was not restarted"
        assert untouched(other[0], wait_sources(api, "south", ["van1"])[0]), "the other site's task was not touched"
        assert [event["data"]["element"] for event in chain.events("~fleet~north")] == ["north"]
        chain.settled()
