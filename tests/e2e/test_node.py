"""The node has the properties that the tests rely on."""

from __future__ import annotations

import base64
import subprocess
import urllib.request
from pathlib import Path

from tests.certificates import Authority
from tests.cluster.api import Api, ApiError
from tests.cluster.waiting import wait_until
from tests.e2e.node import Node
from tests.e2e.programs import SYSTEM_PATH
from tests.e2e.workloads import deployment, running_pods, service, wait_available

SERVE = ("python3", "-c", "import http.server as h; h.test(h.SimpleHTTPRequestHandler, port=8000)")
FETCH = "import sys, urllib.request as r; print(r.urlopen(sys.argv[1], timeout=5).status)"
REFUSE = """
import http.server, json, ssl
class Handler(http.server.BaseHTTPRequestHandler):
    def do_POST(self):
        review = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        status = {"message": "the pod refuses"}
        answer = {"uid": review["request"]["uid"], "allowed": False, "status": status}
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.end_headers()
        self.wfile.write(json.dumps({**{k: review[k] for k in ("apiVersion", "kind")}, "response": answer}).encode())
server = http.server.HTTPServer(("", 8443), Handler)
context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
context.load_cert_chain("/tls/tls.crt", "/tls/tls.key")
server.socket = context.wrap_socket(server.socket, server_side=True)
server.serve_forever()
"""


def test_a_deployment_of_our_image_runs_and_logs_and_exec_work(node: Node, api: Api, image: str) -> None:
    reported = "print('it runs', flush=True); import time; time.sleep(10**6)"
    api.apply(deployment("app", image, ("python3", "-c", reported)))
    pod = wait_available(api, "app")["metadata"]["name"]

    logged = wait_until(
        lambda: node.plane.kubectl("--namespace", api.namespace, "logs", pod), bool, what="the pod has logged"
    )
    assert logged == "it runs\n"
    for program in ("detector", "application-manager"):
        assert "Usage" in node.plane.kubectl("--namespace", api.namespace, "exec", pod, "--", program, "--help")
    who = "import os; print(os.getuid())"
    assert node.plane.kubectl("-n", api.namespace, "exec", pod, "--", "python3", "-c", who) == "65532\n"


def test_a_service_is_reached_by_its_name_from_a_pod_and_by_its_port_from_outside(
    node: Node, api: Api, image: str
) -> None:
    api.apply(deployment("web", image, SERVE, port=8000, container={"workingDir": "/etc"}))
    reached = api.apply(service("web", 80, 8000, type="NodePort"))
    pod = wait_available(api, "web")["metadata"]["name"]

    fetch = ("--namespace", api.namespace, "exec", pod, "--", "python3", "-c", FETCH)
    for name in ("web", f"web.{api.namespace}.svc.cluster.local"):
        answer = wait_until(
            lambda name=name: node.plane.kubectl(*fetch, f"http://{name}"),  # type: ignore[misc]
            bool,
            what=f"the pod reaches {name}",
            transient=(RuntimeError,),
        )
        assert answer == "200\n"

    url = f"http://{node.address}:{reached['spec']['ports'][0]['nodePort']}/hostname"
    assert wait_until(
        lambda: urllib.request.urlopen(url, timeout=5).status, bool, what="NodePort answers", transient=(OSError,)
    )


def test_a_pod_can_query_the_api_server_with_its_own_account(node: Node, api: Api, image: str) -> None:
    api.apply(deployment("app", image, ("python3", "-c", "import time; time.sleep(10**6)")))
    pod = wait_available(api, "app")["metadata"]["name"]
    ask = (
        "from kubernetes import client, config; config.load_incluster_config(); "
        "print(client.VersionApi().get_code().git_version)"
    )
    answer = node.plane.kubectl("--namespace", api.namespace, "exec", pod, "--", "python3", "-c", ask)
    assert answer == "v1.36.3\n"


def test_the_api_server_reaches_a_webhook_on_a_pod(node: Node, api: Api, image: str, tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    certificate, key = authority.sign("hook", f"hook.{api.namespace}.svc")
    encoded = {name: base64.b64encode(file.read_bytes()).decode() for name, file in
               (("tls.crt", certificate), ("tls.key", key))}  # fmt: skip
    secret = {"apiVersion": "v1", "kind": "Secret", "metadata": {"name": "hook"}, "type": "kubernetes.io/tls"}
    api.apply(secret | {"data": encoded})
    volume = {"name": "tls", "secret": {"secretName": "hook"}}
    mount = {"volumeMounts": [{"name": "tls", "mountPath": "/tls"}]}
    api.apply(deployment("hook", image, ("python3", "-c", REFUSE), port=8443, container=mount, volumes=[volume]))
    api.apply(service("hook", 443, 8443))
    wait_available(api, "hook")
    authority_bundle = base64.b64encode(authority.ca.read_bytes()).decode()
    hook = {
        "name": "hook.wayside.test",
        "rules": [{"apiGroups": [""], "apiVersions": ["v1"], "operations": ["CREATE"], "resources": ["configmaps"]}],
        "namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": api.namespace}},
        "matchConditions": [{"name": "requested", "expression": "object.metadata.name == 'requested'"}],
        "clientConfig": {"service": {"namespace": api.namespace, "name": "hook"}, "caBundle": authority_bundle},
        "admissionReviewVersions": ["v1"],
        "sideEffects": "None",
    }
    kind = "ValidatingWebhookConfiguration"
    api.apply(
        {
            "apiVersion": "admissionregistration.k8s.io/v1",
            "kind": kind,
            "metadata": {"name": api.namespace},
            "webhooks": [hook],
        }
    )
    try:

        def refusal() -> str:
            requested = {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "requested"}}
            try:
                api.create(requested)
            except ApiError as error:
                return error.message
            api.delete("ConfigMap", "requested")  # the API server may not have loaded the webhook configuration yet
            return ""

        output = wait_until(refusal, lambda output: "the pod refuses" in output, what="the webhook is called")
        assert "hook.wayside.test" in output
    finally:
        api.delete(kind, api.namespace)


def test_pods_outlive_kubelet_and_containerd(node: Node, api: Api, image: str) -> None:
    api.apply(deployment("app", image, ("python3", "-c", "import time; time.sleep(10**6)")))
    before = wait_available(api, "app")

    node.stop_program("kubelet")
    node.stop_program("containerd")
    node.start_containerd()
    node.start_kubelet()
    node.wait_ready()

    api.apply(deployment("later", image, ("python3", "-c", "import time; time.sleep(10**6)")))
    wait_available(api, "later")
    (after,) = running_pods(api, "app")
    assert after["metadata"]["uid"] == before["metadata"]["uid"]
    assert after["status"]["containerStatuses"][0]["restartCount"] == 0


def test_what_the_programs_write_is_inside_and_not_on_the_machine(node: Node, api: Api, image: str) -> None:
    """The machine may have folders of the same names, from other clusters or a Docker daemon."""
    api.apply(deployment("app", image, ("python3", "-c", "import time; time.sleep(10**6)")))
    wait_available(api, "app")
    for folder in ("/var/lib/cni", "/var/lib/kubelet", "/var/log/containers", "/run/containerd"):
        look = ("find", folder, "-maxdepth", "3", "-ignore_readdir_race")  # container roots are deeper
        inside = node.enclosure.run(*look, path=SYSTEM_PATH).splitlines()
        outside = subprocess.run(look, capture_output=True, text=True, check=False).stdout.splitlines()
        assert {*inside} - {*outside}, f"no entry of {folder} is the node's alone"
