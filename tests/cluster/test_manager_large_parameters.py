"""Merged values that are too large stop the update of their one instance, which names the largest contributors."""

from __future__ import annotations

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api, Object
from tests.cluster.expected_objects import condition, config, deployment, end, task, template
from tests.cluster.processes import Process

NORTH, SOUTH = instance_name("app", "north"), instance_name("app", "south")
CONFIG = f"{NORTH}-config"


def sources(letter: str, count: int) -> list[str]:
    return [f"{letter * 1000}{number}" for number in range(count)]


def too_large(raw: Object) -> bool:
    applied = condition(raw, "Applied")
    return applied.get("status") == "False" and "more than the 65536 allowed" in applied["message"]


def test_a_union_that_is_too_large_stops_updates_of_its_own_instance_only(api: Api, manager: Process) -> None:
    parameters = {"region": {"type": "string"}, "sources": {"type": "array", "items": "string", "merge": "Union"}}
    manifests = [deployment(), config({"sources": "${parameters.sources}!"})]
    api.create(template(parameters=parameters, manifests=manifests))
    api.create(task("small", region="north", sources=["car1"]))
    api.wait_for("ConfigMap", CONFIG, lambda raw: raw["data"]["sources"] == '["car1"]!', what="the first instance runs")
    for name, count in (("large", 40), ("larger", 50)):
        api.create(task(name, region="north", sources=sources(name[-1], count)))
    instance = api.wait_for("ApplicationInstance", NORTH, too_large, what="the instance reports why it is unchanged")
    reported = condition(instance, "Applied")
    assert reported["reason"] == "ParametersTooLarge"
    assert "task larger gives 50" in reported["message"]
    assert reported["message"].index("task larger") < reported["message"].index("task large gives")
    waiting = api.wait_for("ApplicationTask", "larger", too_large, what="the task reports it too")
    assert waiting["status"]["phase"] == "Pending"

    api.create(task("elsewhere", region="south", sources=["car2"]))
    api.wait_for("Deployment", SOUTH, lambda _: True, what="another instance of the template is created")
    for name in ("first", "second"):  # an instance that would be too large from the start
        api.create(task(name, region="west", sources=sources(name[0], 40)))
    api.wait_for("ApplicationTask", "second", too_large, what="the second one reports that both are too large")

    end(api, "larger")
    expected = len(str(sources("e", 40)))
    api.wait_for("ConfigMap", CONFIG, lambda raw: len(raw["data"]["sources"]) > expected - 100, what="the rest fits")
    api.wait_for(
        "ApplicationInstance", NORTH, lambda raw: condition(raw, "Applied")["status"] == "True", what="it is applied"
    )
