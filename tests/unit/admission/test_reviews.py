"""Admission reviews and their responses: only a changed spec is ever rejected."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from kubernetes.aio.client import Configuration

from application_manager.admission.admission import AT_ONCE, Admission
from application_manager.cache.cluster_cache import ClusterCache
from application_manager.core.findings.findings import Findings
from application_manager.core.findings.reviews import LONGEST, MOST_REPORTED, OverloadedError, ReviewError, answer, read
from application_manager.core.findings.webhooks import WebhookClientConfig, webhook_configuration
from application_manager.core.objects.policy import Policy
from application_manager.measures import Measures
from application_manager.workers.process import Job
from tests.inprocess import InProcess, Result
from tests.unit.manager_objects import template
from tests.unit.templates.test_findings import counting, deploying, detector, rule
from wayside.api import Kind
from wayside.findings import Finding
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError
from wayside.kubernetes.resources import Resource

EARLY = Finding("rule-not-selected", "it is early")
WRONG = Findings(("spec.when: is wrong",), (EARLY,))


def question(
    operation: str = "CREATE", new: Any = None, old: Any = None, kind: str = "EventRule", **more: Any
) -> dict[str, Any]:
    requested = {
        "uid": "u1",
        "kind": {"group": "wayside.dev", "version": "v1alpha1", "kind": kind},
        "namespace": "site",
        "name": "fast",
        "operation": operation,
        "object": new,
        "oldObject": old,
        **more,
    }
    return {"apiVersion": "admission.k8s.io/v1", "kind": "AdmissionReview", "request": requested}


def answered(review: dict[str, Any], findings: Findings = WRONG) -> dict[str, Any]:
    response = answer(read(review), findings)["response"]
    assert isinstance(response, dict)
    assert response["uid"] == "u1"
    return response


OBJECT: dict[str, Any] = {"metadata": {"name": "fast", "labels": {"a": "b"}}, "spec": {"when": "x"}}


def test_an_invalid_new_object_is_rejected_by_field() -> None:
    response = answered(question(new=OBJECT))
    assert (response["allowed"], response["warnings"]) == (False, ["it is early [rule-not-selected]"])
    assert (response["status"]["code"], response["status"]["message"]) == (422, "spec.when: is wrong")
    (cause,) = response["status"]["details"]["causes"]
    assert (cause["field"], cause["message"]) == ("spec.when", "is wrong")


def test_a_finding_of_severity_warning_is_only_a_warning() -> None:
    response = answered(question(new=OBJECT), Findings((), (EARLY,)))
    assert (response["allowed"], response["warnings"]) == (True, ["it is early [rule-not-selected]"])


def test_a_warning_that_the_annotation_names_is_left_out_and_an_error_is_not() -> None:
    ignoring = {"annotations": {"wayside.dev/ignore-findings": "invalid-rule, rule-not-selected"}}
    response = answered(question(new=OBJECT | {"metadata": OBJECT["metadata"] | ignoring}))
    assert (response["allowed"], response["status"]["message"]) == (False, "spec.when: is wrong")
    assert "warnings" not in response


METADATA = st.fixed_dictionaries(
    {"name": st.just("fast")},
    optional={
        "labels": st.dictionaries(st.sampled_from("ab"), st.sampled_from("xy"), max_size=2),
        "annotations": st.dictionaries(st.sampled_from("ab"), st.sampled_from("xy"), max_size=2),
        "finalizers": st.lists(st.sampled_from("ab"), max_size=2),
    },
)


@given(METADATA, METADATA, st.sampled_from(["", "status", "scale"]))
def test_an_update_without_a_spec_change_is_never_rejected(new: Any, old: Any, subresource: str) -> None:
    spec = {"when": "wrong as it was"}
    changed, stored = {"metadata": new, "spec": spec, "status": {"n": 1}}, {"metadata": old, "spec": spec}
    response = answered(question("UPDATE", changed, stored, subResource=subresource))
    assert response["allowed"]
    relabelled = new.get("labels") != old.get("labels") and not subresource
    assert ("warnings" in response) is relabelled


@pytest.mark.parametrize(
    "review",
    [
        question("DELETE", None, OBJECT),
        question("CONNECT", OBJECT),
        question(new=OBJECT, kind="ApplicationTask"),
        question(new=OBJECT, kind="ApplicationInstance"),
        question("UPDATE", {**OBJECT, "metadata": {"name": "f", "deletionTimestamp": "2026-01-01T00:00:00Z"}}, {}),
        question("UPDATE", {**OBJECT, "spec": {}}, OBJECT, subResource="status"),
    ],
    ids=["deleted", "connected", "task", "instance", "going", "status"],
)
def test_kinds_without_checks_are_allowed_silently(review: dict[str, Any]) -> None:
    assert answered(review) == {"uid": "u1", "allowed": True}


@given(st.lists(st.text(max_size=40).map(lambda text: text * 60), max_size=40))
def test_warnings_are_limited_in_number_and_length(texts: list[str]) -> None:
    found = Findings((), tuple(Finding("early", each) for each in texts))
    warnings = answered(question(new=OBJECT), found).get("warnings", [])
    assert len(warnings) <= MOST_REPORTED + 1
    assert all(len(each) <= LONGEST and each.isprintable() for each in warnings)


@pytest.mark.parametrize(
    "requested", [None, [], {}, {"apiVersion": "admission.k8s.io/v1"}, question() | {"request": {}}]
)
def test_an_invalid_review_is_reported(requested: Any) -> None:
    with pytest.raises(ReviewError, match="only the API server may call this path"):
        read(requested)


def test_unknown_kinds_are_dropped_and_names_are_sanitized() -> None:
    assert read(question(new=OBJECT, kind="Anything\n")).kind == ""
    named = {"metadata": {"name": "a\nb"}, "spec": {}}
    assert answered(question(new=named))["status"]["details"]["name"] == "a b"


def test_the_webhook_configuration_covers_three_kinds_and_fails_open() -> None:
    made = webhook_configuration(WebhookClientConfig.of_service("wayside/manager:8443"), b"PEM", ["b", "a"])
    (webhook,) = made["webhooks"]
    service = {"namespace": "wayside", "name": "manager", "port": 8443, "path": "/admission"}
    assert webhook["clientConfig"] == {"service": service, "caBundle": "UEVN"}
    assert (webhook["failurePolicy"], webhook["sideEffects"], webhook["timeoutSeconds"]) == ("Ignore", "None", 5)
    (requested,) = webhook["rules"]
    assert requested["resources"] == ["applicationtemplates", "detectors", "eventrules"]
    assert requested["operations"] == ["CREATE", "UPDATE"]
    assert webhook["namespaceSelector"]["matchExpressions"][0]["values"] == ["a", "b"]


@pytest.mark.parametrize("url", ["http://a", "https://", "a:1", "https://a/b", "https://u@a", "https://a:123456"])
def test_an_invalid_webhook_address_is_rejected(url: str) -> None:
    with pytest.raises(ValueError, match="must be https://HOST:PORT"):
        WebhookClientConfig.of_url(url)
    with pytest.raises(ValueError, match="must be NAMESPACE/NAME"):
        WebhookClientConfig.of_service(url)


# --- Rules and detectors are judged with each other


class Cluster(Client):
    """An API server with these objects; it is away where there are none."""

    def __init__(self, *objects: Kind) -> None:
        super().__init__(Configuration(), "test", field_manager="test")
        self.objects = objects

    async def list(
        self, resource: Resource, namespace: str | None, *, labels: str = "", fields: str = "", limit: int = 0
    ) -> tuple[list[dict[str, Any]], str]:
        if not self.objects:
            raise ApiError(503, "away")
        return [raw(each) for each in self.objects if each.kind == resource.kind], "9"


def raw(model: Kind, version: int = 9) -> dict[str, Any]:
    made = model.to_json()
    made["metadata"] |= {"uid": f"uid-{model.name}", "resourceVersion": str(version)}
    return made


def reviewed(
    new: Kind, *known: Kind, live: tuple[Kind, ...] = (), old: Kind | None = None, namespaces: tuple[str, ...] = ()
) -> dict[str, Any]:
    """The response if the manager's cache and the API server have different objects."""

    async def ask() -> dict[str, Any]:
        cache = ClusterCache(Policy())
        for each in known:
            cache.store.put(raw(each, 1))
        client = Cluster(*live)
        admission = Admission(cache, client, cache.store.put, Measures(), InProcess(), namespaces)
        requested = question("CREATE" if old is None else "UPDATE", new.to_json(), old and old.to_json(), new.kind)
        try:
            return await admission.review(requested)
        finally:
            await client.close()

    response = asyncio.run(ask())["response"]
    assert isinstance(response, dict)
    return response


def test_a_rules_findings_about_its_detector_are_confirmed_at_the_api_server() -> None:
    old, new = detector(stream="odometry"), detector()
    assert reviewed(rule(), old, live=(new,)) == {"uid": "u1", "allowed": True}
    assert reviewed(rule(), live=(new,)) == {"uid": "u1", "allowed": True}
    assert not reviewed(rule(), old, live=(old,))["allowed"]
    assert reviewed(counting("many", "fast"), new, live=(new, rule())) == {"uid": "u1", "allowed": True}


def test_an_unconfirmed_finding_is_a_warning() -> None:
    response = reviewed(rule(), detector(stream="odometry"))
    assert response["allowed"]
    assert "no stream pose" in response["warnings"][0]


def test_findings_about_the_rule_alone_reject_it_without_a_lookup() -> None:
    response = reviewed(rule(when="sped > 3"))
    assert response["status"]["message"].startswith("spec.when: line 1, column 1: `sped`")


def test_removing_a_stream_that_rules_use_gives_a_warning() -> None:
    before, after = detector(), detector(stream="odometry")
    response = reviewed(after, before, rule(), old=before)
    assert response["allowed"]
    assert response["warnings"][0].startswith("EventRule fast, spec.signals[0].stream")
    assert "warnings" not in reviewed(detector(clientTimeout="9s", stream="odometry"), after, rule(), old=after)


def test_a_template_named_by_a_rule_is_looked_up_before_it_is_reported_missing() -> None:
    missed = reviewed(deploying(), detector(), live=(detector(),))
    assert missed["allowed"]
    assert "there is no ApplicationTemplate app" in missed["warnings"][0]
    assert reviewed(deploying(), detector(), live=(detector(), template())) == {"uid": "u1", "allowed": True}


class Held:
    """Jobs that wait until they are let."""

    def __init__(self) -> None:
        self.waiting = 0
        self.proceed = asyncio.Event()

    async def run(self, namespace: str, job: Job[Result]) -> Result:
        self.waiting += 1
        await self.proceed.wait()
        return job()


def test_a_namespace_with_too_many_reviews_gets_no_more_and_others_get_theirs() -> None:
    async def scenario() -> None:
        cache, pool, client = ClusterCache(Policy()), Held(), Cluster()
        admission = Admission(cache, client, cache.store.put, Measures(), pool)
        wanted = question("CREATE", detector().to_json(), None, "Detector")
        elsewhere = {**wanted, "request": {**wanted["request"], "namespace": "other"}}
        reviews = [asyncio.create_task(admission.review(wanted)) for _ in range(AT_ONCE)]
        while pool.waiting < AT_ONCE:  # noqa: ASYNC110
            await asyncio.sleep(0)
        with pytest.raises(OverloadedError, match=f"{AT_ONCE} reviews of namespace site are in progress"):
            await admission.review(wanted)
        reviews.append(asyncio.create_task(admission.review(elsewhere)))
        while pool.waiting <= AT_ONCE:  # noqa: ASYNC110
            await asyncio.sleep(0)
        pool.proceed.set()
        assert all(each["response"]["allowed"] for each in await asyncio.gather(*reviews))
        await client.close()

    asyncio.run(scenario())


def test_objects_of_unmanaged_namespaces_are_not_checked() -> None:
    assert reviewed(rule(when="sped > 3"), namespaces=("other",)) == {"uid": "u1", "allowed": True}


def test_an_unparsable_object_is_rejected() -> None:
    broken = rule().model_copy(update={"kind": "Detector"})
    assert "spec.streams: is missing" in reviewed(broken)["status"]["message"]
