"""Which pods get the annotation of a configuration; and the example's rule for two sources of content."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType
from typing import Any

import pytest

from application_manager.core.objects.configuration import ANNOTATION, fingerprint, selectors, unannounced_pods
from tests.guides import ROOT

FILE = ROOT / "examples" / "live-configuration" / "follow.py"


def pod(volume: dict[str, Any], *, reported: str = "", **more: Any) -> dict[str, Any]:
    metadata = {"name": "pod", "uid": "u", "annotations": {ANNOTATION: reported} if reported else {}}
    return {"kind": "Pod", "metadata": metadata, "spec": {"volumes": [{"name": "v", **volume}]}, **more}


DIRECT = {"configMap": {"name": "app-configuration"}}
PROJECTED = {"projected": {"sources": [{"secret": {"name": "s"}}, DIRECT]}}


@pytest.mark.parametrize("volume", [DIRECT, PROJECTED])
def test_a_pod_that_mounts_the_configuration_is_behind_until_it_is_annotated(volume: dict[str, Any]) -> None:
    content = fingerprint({"a": "b"})
    assert list(unannounced_pods([pod(volume)], "app", content)) == [("pod", "u")]
    assert list(unannounced_pods([pod(volume, reported="other")], "app", content)) == [("pod", "u")]
    assert list(unannounced_pods([pod(volume, reported=content)], "app", content)) == []


def test_pods_that_do_not_mount_it_or_are_over_are_left_alone() -> None:
    others = [
        pod({"configMap": {"name": "other-configuration"}}),
        pod({"emptyDir": {}}),
        pod(DIRECT, status={"phase": "Succeeded"}),
        {"metadata": {"name": "bare", "uid": "u"}, "spec": {}},
    ]
    others[0]["metadata"]["deletionTimestamp"] = "now"
    assert list(unannounced_pods(others, "app", "x")) == []


def test_pods_are_listed_by_their_workloads_selector() -> None:
    template = {"metadata": {"labels": {"app": "x", "version": "2"}}, "spec": {}}
    deployment = {"kind": "Deployment", "spec": {"selector": {"matchLabels": {"app": "x"}}, "template": template}}
    cron_job = {"kind": "CronJob", "spec": {"jobTemplate": {"spec": {"template": template}}}}
    service = {"kind": "Service", "spec": {"selector": {"app": "y"}}}
    assert selectors([deployment, cron_job, service, {"kind": "Secret"}]) == ("app=x", "app=x,version=2")
    bare = {"kind": "Pod", "metadata": {"name": "x"}, "spec": {"containers": []}}
    assert selectors([deployment, bare]) == ("",)


def test_the_fingerprint_does_not_depend_on_the_order_of_files() -> None:
    assert fingerprint({"a": "1", "b": "2"}) == fingerprint({"b": "2", "a": "1"}) != fingerprint({"a": "1"})


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("follow_example", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_a_late_file_does_not_override_a_newer_zenoh_message(example: ModuleType) -> None:
    latest = example.Latest()
    assert latest.by_file("old", 0.0)
    assert latest.by_zenoh("new", 1.0)
    assert not latest.by_file("old", 2.0)
    assert not latest.by_file("new", 3.0)
    assert latest.content == "new"


def test_the_file_wins_once_zenoh_is_silent(example: ModuleType) -> None:
    latest = example.Latest()
    latest.by_zenoh("one", 0.0)
    latest.by_zenoh("two", 1.0)
    assert not latest.by_file("one", 1.0 + example.MEMORY / 2)
    assert latest.by_file("one", 1.5 + example.MEMORY)
    assert latest.by_file("three", 2.0 + example.MEMORY)
    assert latest.content == "three"


def test_zenoh_counts_again_when_it_returns(example: ModuleType) -> None:
    latest = example.Latest()
    for content in ("one", "two", "one"):
        assert latest.by_zenoh(content, 0.0)
    assert not latest.by_file("two", 1.0)
    assert not latest.by_file("one", 1.0)
    assert latest.content == "one"
