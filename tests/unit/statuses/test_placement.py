"""Unmatched constraints are reported by field and value, with the existing values; matched ones are not."""

from __future__ import annotations

from typing import Any

import pytest

from application_manager.core.health.placement import selects_nodes, unschedulable

NODES = {
    "rsu-1": {"kubernetes.io/hostname": "rsu-1", "site": "north", "gpus": "2"},
    "rsu-2": {"kubernetes.io/hostname": "rsu-2", "site": "south"},
}


def deployment(**spec: Any) -> dict[str, Any]:
    return {"kind": "Deployment", "metadata": {"name": "app"}, "spec": {"template": {"spec": spec}}}


def affinity(*terms: Any) -> dict[str, Any]:
    required = {"nodeSelectorTerms": [{"matchExpressions": list(each)} for each in terms]}
    return {"affinity": {"nodeAffinity": {"requiredDuringSchedulingIgnoredDuringExecution": required}}}


def expression(key: str, operator: str, *values: str) -> dict[str, Any]:
    return {"key": key, "operator": operator, "values": list(values)}


@pytest.mark.parametrize(
    ("spec", "shows"),
    [
        ({"nodeName": "rsu-9"}, "nodeName: there is no node rsu-9 (there are rsu-1, rsu-2)"),
        ({"nodeSelector": {"site": "west"}}, "nodeSelector: no node has the label site=west (there are north, south)"),
        ({"nodeSelector": {"zone": "a"}}, "no node has the label zone=a (no node has a label with this key)"),
        (
            {"nodeSelector": {"site": "south", "gpus": "2"}},
            "fits no node: no node meets all requirements together: nodeSelector gpus=2; nodeSelector site=south.",
        ),
        (affinity([expression("site", "In", "west", "east")]), "no node has the label site=west or east (there are"),
        (affinity([expression("gpus", "Gt", "2")]), "no node has the label gpus Gt 2 (there is 2)"),
        (
            affinity([expression("site", "In", "west")], [expression("disk", "Exists")]),
            "no node has the label site=west, or the label disk",
        ),
    ],
)
def test_constraints_that_match_no_node_are_reported(spec: Any, shows: str) -> None:
    found = unschedulable(deployment(**spec), NODES)
    assert found is not None
    assert found.reason == "Unschedulable"
    assert found.message.startswith("Deployment app fits no node: ")
    assert shows in found.message
    assert "Correct the value, or label a node" in found.message


@pytest.mark.parametrize(
    "spec",
    [
        {},
        {"tolerations": [{"operator": "Exists"}]},
        {"nodeName": "rsu-2"},
        {"nodeSelector": {"kubernetes.io/hostname": "rsu-1", "site": "north"}},
        affinity([expression("site", "In", "west")], [expression("site", "NotIn", "north")]),
        affinity([expression("gpus", "Gt", "1"), expression("site", "Exists")]),
        affinity([expression("gpus", "DoesNotExist")]),
        {"affinity": {"nodeAffinity": {"preferredDuringSchedulingIgnoredDuringExecution": [{"weight": 1}]}}},
    ],
)
def test_constraints_that_match_a_node_are_not_reported(spec: Any) -> None:
    assert unschedulable(deployment(**spec), NODES) is None


def test_without_nodes_only_required_constraints_are_reported() -> None:
    found = unschedulable(deployment(nodeSelector={"site": "north"}), {})
    assert found is not None
    assert "(there are no nodes)" in found.message
    assert unschedulable(deployment(), {}) is None


@pytest.mark.parametrize(
    ("live", "placed"),
    [
        ({"kind": "Pod", "spec": {"nodeName": "x"}}, True),
        ({"kind": "Job", "spec": {"template": {"spec": {"nodeName": "x"}}}}, True),
        ({"kind": "CronJob", "spec": {"jobTemplate": {"spec": {"template": {"spec": {"nodeName": "x"}}}}}}, True),
        ({"kind": "ConfigMap", "data": {}}, False),
        ({"kind": "Service", "spec": {"selector": {"a": "b"}}}, False),
    ],
)
def test_the_pods_of_each_kind_are_checked(live: Any, placed: bool) -> None:
    assert selects_nodes(live) is placed
