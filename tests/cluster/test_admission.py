"""The API server calls the manager before it stores a template, rule or detector; an outage blocks no request."""

from __future__ import annotations

import copy
import http.server
import json
import os
import re
import signal
import ssl
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

from application_manager.core.findings.webhooks import TIMEOUT
from tests.certificates import Authority
from tests.cluster.api import Api, ApiError, Object
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import condition, config, deployment, end, start_manager, task, template
from tests.cluster.manifests import DETECTOR, EVENT_RULE
from tests.cluster.processes import Processes
from tests.cluster.waiting import wait_until
from tests.cluster.webhook import Webhook, kubectl_apply, printed

LABELS = {"site": "intersection-a"}


@pytest.fixture
def webhook(api: Api, processes: Processes, tmp_path: Path) -> Webhook:
    return Webhook(processes, api, tmp_path / "certificates")


def detector() -> Object:
    made = copy.deepcopy(DETECTOR)
    made["spec"]["streams"] += [
        {"name": name, "key": f"vehicles/${{client:*}}/{name}", "encoding": "json"} for name in ("points", "odometry")
    ]
    return made


def rule(name: str = "close", **spec: Any) -> Object:
    made = copy.deepcopy(EVENT_RULE)
    made["metadata"] = {"name": name, "labels": LABELS}
    made["spec"] |= spec
    return made


def reported(api: Api, kind: str, name: str) -> Object:
    """The condition Accepted, once it is about the current spec."""
    found = api.wait_for(
        kind,
        name,
        lambda raw: condition(raw, "Accepted").get("observedGeneration") == raw["metadata"]["generation"],
        what=f"the status of {kind} {name} is that of its spec",
    )
    return condition(found, "Accepted")


WRONG: list[tuple[Object, Object, list[str]]] = [
    # a valid object, the change that makes it invalid, and the message
    (
        template("unknown"),
        {"manifests": [deployment("app:${parameters.version}")]},
        ["spec.manifests[0]", "image, line 1, column", "`parameters.version` does not exist", "region"],
    ),
    (template("typed"), {"manifests": [config({"x": "${parameters.region + 1}"})]}, ["data.x", "`+` does not take"]),
    (
        template("forbidden"),
        {"manifests": [{"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": "${instance.name}"}}]},
        ["spec.manifests[0].kind: v1/ServiceAccount is not a kind that the administrator allows"],
    ),
    (
        template("elsewhere"),
        {"manifests": [{**config({}), "metadata": {"name": "${instance.name}", "namespace": "kube-system"}}]},
        ["spec.manifests[0].metadata.namespace: 'kube-system'", "remove the field"],
    ),
    (
        template("misnamed"),
        {"manifests": [config({}, name="${instance.name}_A")]},
        ["spec.manifests[0].metadata.name", "must have at most 253 lower-case letters"],
    ),
    (
        template("the-same"),
        {"manifests": [config({}, name="fixed")]},
        ["spec.manifests[0].metadata.name: 'fixed'", "must contain ${instance.name}"],
    ),
    (
        template("charted"),
        {"manifests": None, "helm": {"chart": "/charts/app", "values": {"rate": "${parameters.rate}"}}},
        ["spec.helm.values.rate", "`parameters.rate` does not exist"],
    ),
    (
        template("incoherent"),
        {"parameters": {"region": {"type": "string", "required": True, "default": "north"}}},
        ["spec.parameters.region", "a required parameter cannot have a default"],
    ),
    (rule("misspelt"), {"when": "distence < 150"}, ["spec.when", "line 1, column 1", "distence", "distance"]),
    (rule("mistyped"), {"until": "distance + 200"}, ["spec.until", "must be a boolean"]),
    (
        rule("streamless"),
        {"signals": [{"name": "speed", "stream": "odometri", "value": "msg.speed"}]},
        ["spec.signals[0].stream", "has no stream odometri", "did you mean odometry?"],
    ),
    (
        rule("large"),
        {
            "actions": [
                {"name": "a", "deploy": {"templateName": "app", "parameters": {"x": "y" * 40_000, "z": "y" * 30_000}}}
            ]
        },
        ["spec.actions[0].deploy.parameters", "exceeds the limit of 65536: shorten the largest value, x"],
    ),
    (
        detector(),
        {"clientTimeout": "30s", "streams": "msg.t +"},
        ["spec.streams[0].stamp", "the expression is incomplete"],
    ),
]


def spoilt(good: Object, change: Object) -> Object:
    """The patch that makes the object invalid."""
    if isinstance(change.get("streams"), str):  # of a stream's stamp
        streams = copy.deepcopy(good["spec"]["streams"])
        streams[0]["stamp"] = change["streams"]
        change = {**change, "streams": streams}
    return {"spec": change}


def test_an_invalid_object_is_rejected_and_without_the_webhook_a_condition_reports_it(
    api: Api, webhook: Webhook
) -> None:
    api.create(detector())
    refusals: dict[str, str] = {}
    with webhook.requested():
        for good, change, parts in WRONG:
            kind, name = good["kind"], good["metadata"]["name"]
            if kind != "Detector":
                api.create(good)
            stored = api.get(kind, name)
            with pytest.raises(ApiError) as refused:
                api.patch(kind, name, spoilt(good, change))
            assert (refused.value.code, refused.value.reason) == (422, "Invalid")
            assert [part for part in parts if part not in refused.value.message] == [], refused.value.message
            assert api.get(kind, name)["spec"] == stored["spec"]
            _, _, refusals[name] = refused.value.message.partition("denied the request: ")
    webhook.wait_unasked()
    for good, _, _ in WRONG:
        kind, name = good["kind"], good["metadata"]["name"]
        assert reported(api, kind, name)["status"] == "True"
    for good, change, _ in WRONG:
        kind, name = good["kind"], good["metadata"]["name"]
        api.patch(kind, name, spoilt(good, change))
        logged = reported(api, kind, name)
        assert (logged["status"], logged["message"]) == ("False", refusals[name])
        if kind == "Detector":
            api.replace({**api.get(kind, name), "spec": good["spec"]})


def test_kubectl_prints_rejections_and_warnings_as_the_guide_shows(
    api: Api, control_plane: ControlPlane, webhook: Webhook, namespace: str
) -> None:
    optional = {"lane": {"type": "string"}}
    doubtful = template("doubtful", parameters=optional, manifests=[config({"lane": "on ${parameters.lane}"})])
    del doubtful["spec"]["key"]
    guide = Path("docs/admission.md").read_text()
    written, shown = (re.search(f"```{kind}\n(.*?)```", guide, re.DOTALL) for kind in ("yaml", "console"))
    assert written is not None
    assert shown is not None
    with webhook.requested():
        _, logged = kubectl_apply(control_plane, yaml.safe_load(written[1]), namespace)
        assert logged.replace(namespace, "default") == shown[1].partition("\n")[2]
        for options in ((), ("--dry-run=server",)):
            code, logged = kubectl_apply(control_plane, rule(when="distence < 150"), namespace, *options)
            assert code != 0
            for part in ('EventRule "close" is invalid', "spec.when", "line 1, column 1", "distence"):
                assert part in logged
        code, logged = kubectl_apply(control_plane, rule(), namespace)
        assert (code, api.get("EventRule", "close")["spec"]["when"]) == (0, "distance < 150")
        warning = f"no valid Detector in namespace {namespace} selects the rule: create a Detector"
        assert f"Warning: {warning} [rule-not-selected]" in logged
        code, logged = kubectl_apply(control_plane, doubtful, namespace)
        assert code == 0
        for part in ("Warning: spec.manifests[0].data.lane", "`parameters.lane` is null", "when tasks give no param"):
            assert part in logged
        code, logged = kubectl_apply(control_plane, detector(), namespace)
        assert (code, logged) == (0, "")
        blind = detector()
        blind["spec"]["streams"] = [each for each in blind["spec"]["streams"] if each["name"] != "odometry"]
        code, logged = kubectl_apply(control_plane, blind, namespace)
        assert code == 0
        assert "Warning: EventRule close, spec.signals[0].stream" in logged


def test_only_a_changed_spec_is_rejected(api: Api, webhook: Webhook) -> None:
    wrong = template("wrong", manifests=[config({}, name="fixed")])
    api.create(wrong)  # while the API server does not call the webhook
    with webhook.requested():
        api.patch("ApplicationTemplate", "wrong", {"metadata": {"labels": {"a": "b"}, "finalizers": ["test.dev/x"]}})
        status = {"status": {"instances": 7}}
        api.patch("ApplicationTemplate", "wrong", status, subresource="status")
        with pytest.raises(ApiError, match="must contain"):
            api.patch("ApplicationTemplate", "wrong", {"spec": {"description": "still wrong"}})
        api.delete("ApplicationTemplate", "wrong")
        api.patch("ApplicationTemplate", "wrong", {"spec": {"description": "going"}})
        api.patch("ApplicationTemplate", "wrong", {"metadata": {"finalizers": None}})
        api.wait_gone("ApplicationTemplate", "wrong")


def test_a_rule_may_be_created_right_after_its_detector(api: Api, webhook: Webhook) -> None:
    api.create(detector())
    with webhook.requested():
        for number in range(10):
            stream = {"name": f"s{number}", "key": f"s{number}/${{client:*}}", "encoding": "json"}
            api.patch("Detector", "intersection-a", [{"op": "add", "path": "/spec/streams/-", "value": stream}])
            signals = [{"name": "speed", "stream": f"s{number}", "value": "msg.speed"}]
            api.create(rule(f"rule-{number}", signals=signals))


def test_a_detectors_pod_is_checked_by_a_dry_run(api: Api, processes: Processes, tmp_path: Path) -> None:
    webhook = Webhook(processes, api, tmp_path / "certificates", options=("--detector-image", "wayside:1"))
    made = detector()
    made["spec"] |= {"mode": "Standalone"}

    def placed(operator: str) -> Object:
        terms = [{"matchExpressions": [{"key": "site", "operator": operator}]}]
        return {"nodeAffinity": {"requiredDuringSchedulingIgnoredDuringExecution": {"nodeSelectorTerms": terms}}}

    with webhook.requested():
        for pod, parts in (
            ({"affinity": placed("Near")}, r"spec\.pod: .*nodeAffinity.*operator: Invalid value: \"?Near"),
            ({"securityContext": {"fsGroop": 7}}, r"spec\.pod: .*fsGroop"),
        ):
            with pytest.raises(ApiError, match=parts):
                api.create({**made, "spec": made["spec"] | {"pod": pod}})
        api.create({**made, "spec": made["spec"] | {"pod": {"affinity": placed("Exists")}}})
        api.wait_for("Deployment", "detector-intersection-a", lambda _: True, what="the detector is deployed")
    assert [each["metadata"]["name"] for each in api.list("Deployment")] == ["detector-intersection-a"]


def test_an_absent_or_hanging_manager_blocks_no_request(api: Api, processes: Processes, tmp_path: Path) -> None:
    webhook = Webhook(processes, api, tmp_path / "certificates", patience=TIMEOUT)
    api.create(template())
    with webhook.requested():
        os.kill(webhook.manager.pid, signal.SIGSTOP)
        api.patch("ApplicationTemplate", "app", {"spec": {"manifests": [config({}, name="hanging")]}})
        os.kill(webhook.manager.pid, signal.SIGCONT)
        webhook.wait_answering()
        webhook.manager.kill9()
        api.patch("ApplicationTemplate", "app", {"spec": {"manifests": [config({}, name="away")]}})
        webhook.manager.start()
        webhook.wait_answering()
        assert reported(api, "ApplicationTemplate", "app")["reason"] == "TemplateInvalid"
        assert webhook.manager.terminate() == 0


def test_a_renewed_certificate_is_served_and_an_unusable_one_is_not(api: Api, webhook: Webhook) -> None:
    with webhook.requested():
        key = webhook.folder / "tls.key"
        old = key.read_bytes()
        key.write_text("no key")
        webhook.manager.wait_for_output("are not a certificate and a key .* keeping the previous certificate")
        webhook.wait_answering()
        key.write_bytes(old)
        api.apply(webhook.certified())  # another authority: its clients trust only certificates that it signed
        webhook.manager.wait_for_output("using the renewed certificate")
        webhook.wait_answering()


@contextmanager
def listener(folder: Path) -> Iterator[tuple[int, Path, list[Object]]]:
    """An HTTPS server that allows everything: its port, its authority's file, and the requests to it."""
    requested: list[Object] = []

    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_POST(self) -> None:
            request = json.loads(self.rfile.read(int(self.headers["Content-Length"])))["request"]
            requested.append(request)
            answer = {"apiVersion": "admission.k8s.io/v1", "kind": "AdmissionReview"}
            body = json.dumps({**answer, "response": {"uid": request["uid"], "allowed": True}}).encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    authority = Authority(folder)
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(*authority.sign("webhook"))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.socket = context.wrap_socket(server.socket, server_side=True)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server.server_port, authority.ca, requested
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_tasks_instances_statuses_and_deletions_are_never_reviewed(
    api: Api, processes: Processes, namespace: str, tmp_path: Path
) -> None:
    start_manager(processes, namespace)
    with listener(tmp_path) as (port, authority, requested):
        url = f"https://127.0.0.1:{port}"
        name = f"wayside-{namespace}"
        options = ("--ca-bundle", str(authority), "--namespace", namespace, "--name", name)
        api.apply(printed("webhooks", "--url", url, *options))
        try:
            wait_until(
                lambda: api.apply(template()) and bool(requested),
                bool,
                what="the API server calls the webhook for templates",
            )
            api.create(task("north"))
            (made,) = api.wait_list("ApplicationInstance", lambda found: len(found) == 1, what="an instance is created")
            end(api, "north")
            api.wait_gone("ApplicationInstance", made["metadata"]["name"])
            api.create(detector())
            api.create(rule())
            for kind, of in (("ApplicationTemplate", "app"), ("Detector", "intersection-a"), ("EventRule", "close")):
                reported(api, kind, of)
                api.delete(kind, of)
            api.delete("ApplicationTask", "north")
        finally:
            api.delete("ValidatingWebhookConfiguration", name)
    found = {(each["kind"]["kind"], each["operation"], each.get("subResource", "")) for each in requested}
    assert {each[0] for each in found} == {"ApplicationTemplate", "Detector", "EventRule"}
    assert {each[1:] for each in found} <= {("CREATE", ""), ("UPDATE", "")}


def holds_lease(api: Api) -> str:
    """The identity of the active manager."""
    found = api.wait_for(
        "Lease",
        "application-manager",
        lambda raw: bool(raw["spec"].get("holderIdentity")),
        what="a manager is active",
    )
    return str(found["spec"]["holderIdentity"])


def test_a_standby_answers_reviews_too(api: Api, processes: Processes, namespace: str, tmp_path: Path) -> None:
    active = start_manager(processes, namespace)
    holder = holds_lease(api)
    webhook = Webhook(processes, api, tmp_path / "certificates")
    with webhook.requested():
        with pytest.raises(ApiError, match="distence"):
            api.create(rule(when="distence < 150"))
        api.create(rule())
    assert active.alive
    assert holds_lease(api) == holder
    assert reported(api, "EventRule", "close")["reason"] == "NotSelected"
