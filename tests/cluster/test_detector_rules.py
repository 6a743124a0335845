"""The Detector and its rules are followed as they change in the API server."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from detector.resources.kubernetes import ClusterRules
from detector.resources.selection import RuleSet
from tests.cluster.api import Api, Object
from tests.cluster.background import Background, background
from tests.cluster.controlplane import ControlPlane
from tests.cluster.waiting import wait_until
from tests.patience import PATIENCE

API_VERSION = "wayside.dev/v1alpha1"
SITE = {"site": "a"}
WITHOUT_SITE = {"key": "site", "operator": "DoesNotExist"}


def detector(**spec: Any) -> Object:
    stream = {"name": "pose", "key": "vehicles/${client:*}/pose", "encoding": "json"}
    full = {"streams": [stream], "ruleSelector": {"matchLabels": SITE}, **spec}
    return {"apiVersion": API_VERSION, "kind": "Detector", "metadata": {"name": "intersection-a"}, "spec": full}


def rule(name: str, labels: dict[str, str] | None = None, **spec: Any) -> Object:
    full = {"when": "speed > 10", "signals": [{"name": "speed", "stream": "pose", "value": "msg.speed"}], **spec}
    metadata = {"name": name, "labels": SITE if labels is None else labels}
    return {"apiVersion": API_VERSION, "kind": "EventRule", "metadata": metadata, "spec": full}


class RulesFollower:
    """Collects the sets of rules in order."""

    def __init__(self, loop: Background, namespace: str):
        self.sets: list[RuleSet] = []
        self.rules = loop.call(self._make(loop, namespace))
        self._future = loop.start(self._follow())

    async def _make(self, loop: Background, namespace: str) -> ClusterRules:
        return ClusterRules(loop.api, namespace, "intersection-a")

    async def _follow(self) -> None:
        async for rule_set in self.rules.follow():
            self.sets.append(rule_set)

    def wait(self, holds: Callable[[RuleSet], bool], what: str, timeout: float = PATIENCE) -> RuleSet:
        sets = wait_until(lambda: self.sets, lambda sets: bool(sets) and holds(sets[-1]), timeout=timeout, what=what)
        return sets[-1]

    def wait_rules(self, *names: str, timeout: float = PATIENCE) -> RuleSet:
        return self.wait(lambda last: names_of(last) == list(names), f"the rules are {names}", timeout)


def names_of(rule_set: RuleSet) -> list[str]:
    return [each.name for each in rule_set.rules]


@pytest.fixture
def following(control_plane: ControlPlane, namespace: str) -> Iterator[RulesFollower]:
    with background(control_plane.kubeconfig) as loop:
        yield RulesFollower(loop, namespace)


def test_selected_rules_are_returned_by_name_and_others_are_not(
    control_plane: ControlPlane, api: Api, namespace: str
) -> None:
    for each in (rule("c"), rule("b", {"site": "b"}), rule("a"), detector()):
        api.create(each)
    with background(control_plane.kubeconfig) as loop:
        following = RulesFollower(loop, namespace)
        following.wait_rules("a", "c")
        assert len(following.sets) == 1, "no set before all objects are listed"


def test_each_change_of_a_rule_is_followed(api: Api, following: RulesFollower) -> None:
    api.create(detector())
    following.wait_rules()
    api.create(rule("a"))
    following.wait_rules("a")
    api.apply(rule("b", {"site": "elsewhere"}))
    api.apply(rule("a", when="speed > 20"))
    following.wait(lambda last: last.rules[0].spec.when == "speed > 20", "the rule is the changed one")
    api.apply(rule("b"))
    following.wait_rules("a", "b")
    api.delete("EventRule", "a")
    following.wait_rules("b")
    api.patch("Detector", "intersection-a", {"spec": {"ruleSelector": {"matchExpressions": [WITHOUT_SITE]}}})
    following.wait_rules()
    api.patch("Detector", "intersection-a", {"spec": {"clientTimeout": "7s"}})
    following.wait(lambda last: last.detector.spec.client_timeout == "7s", "the Detector is the changed one")


def test_a_changed_status_or_annotation_is_ignored(api: Api, following: RulesFollower) -> None:
    api.create(detector())
    api.create(rule("a"))
    following.wait_rules("a")
    before = len(following.sets)
    api.patch("EventRule", "a", {"status": {"observedGeneration": 1}}, subresource="status")
    api.patch("EventRule", "a", {"metadata": {"annotations": {"note": "to self"}}})
    api.create(rule("b"))
    following.wait_rules("a", "b")
    assert len(following.sets) == before + 1


def test_the_last_known_rules_are_kept_while_the_detector_is_missing(
    api: Api, following: RulesFollower, caplog: pytest.LogCaptureFixture
) -> None:
    wait_until(lambda: caplog.text, lambda text: "no Detector 'intersection-a'" in text, what="the log reports it")
    api.create(detector())
    api.create(rule("a"))
    following.wait_rules("a")
    before = len(following.sets)
    api.delete("Detector", "intersection-a")
    wait_until(lambda: caplog.text.count("no Detector"), lambda n: n == 2, what="it is logged again")
    # Only now: Detectors and rules have separate watches, and the rule's may be faster.
    deploy = {"name": "x", "deploy": {"templateName": "t", "parameters": {"not-an-identifier": 1}}}
    api.create(rule("b"))
    api.create(rule("c", actions=[deploy]))
    wait_until(lambda: following.rules.problems, bool, what="the rules that were created meanwhile are known")
    assert len(following.sets) == before
    api.create(detector(clientTimeout="7s"))
    following.wait(lambda last: last.detector.spec.client_timeout == "7s", "the recreated Detector is followed")
    assert [names_of(each) for each in following.sets[before:]] == [["a", "b"]]


def test_an_unreadable_rule_is_reported_and_skipped(
    api: Api, following: RulesFollower, caplog: pytest.LogCaptureFixture
) -> None:
    # A CRD's schema cannot constrain a map's keys, so the API server accepts this.
    deploy = {"name": "x", "deploy": {"templateName": "t", "parameters": {"not-an-identifier": 1}}}
    api.create(detector())
    api.create(rule("broken", actions=[deploy]))
    api.create(rule("sound"))
    following.wait_rules("sound")
    wait_until(lambda: following.rules.problems, bool, what="the problem is known")
    assert "not-an-identifier" in following.rules.problems["EventRule broken"]
    assert "cannot read the EventRule broken" in caplog.text
    api.patch("EventRule", "broken", {"spec": {"actions": []}})
    following.wait_rules("broken", "sound")
    assert following.rules.problems == {}


@pytest.mark.own_control_plane
def test_changes_during_an_outage_are_seen_after_it(
    control_plane: ControlPlane, api: Api, following: RulesFollower
) -> None:
    api.create(detector())
    api.create(rule("a"))
    api.create(rule("b"))
    following.wait_rules("a", "b")
    before = len(following.sets)
    with control_plane.outage():
        assert len(following.sets) == before
    api.delete("EventRule", "a")
    api.create(rule("c"))
    following.wait_rules("b", "c")
    assert all(set(names_of(each)) & {"a", "b"} for each in following.sets[before:]), "the outage removed no rule"
