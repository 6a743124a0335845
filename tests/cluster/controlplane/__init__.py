"""A real control plane of one machine: etcd, kube-apiserver and kube-controller-manager on loopback ports.

What is real: storage, admission, authentication, RBAC, TLS, garbage collection, the controllers of the workloads.
What is missing: nodes. Pods are created and stay pending until a test marks them (see `tests.cluster.pods`).

The order of the start matters once: the CRDs come before the controller manager, because its garbage collector looks
for new kinds only every 30 s, and would leave the children of an ApplicationInstance alone until then.

`python -m tests.cluster.controlplane` runs one until Ctrl-C.
"""

from __future__ import annotations

import os
import secrets
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

from tests.cluster.api import Api, ApiError, Unreachable
from tests.cluster.binaries import Binaries, ensure_binaries
from tests.cluster.children import Child, log_tail, remove_afterwards
from tests.cluster.controlplane import commands
from tests.cluster.controlplane.kubeconfig import new_token, write_kubeconfig
from tests.cluster.controlplane.site import LOOPBACK, Site
from tests.cluster.crds import apply_crds
from tests.cluster.waiting import wait_until
from tests.patience import PATIENCE
from tests.ports import free_ports

_CONTROLLERS_RIGHTS = {
    "apiVersion": "rbac.authorization.k8s.io/v1",
    "kind": "ClusterRoleBinding",
    "metadata": {"name": "test-controllers"},
    "roleRef": {"apiGroup": "rbac.authorization.k8s.io", "kind": "ClusterRole", "name": "cluster-admin"},
    "subjects": [{"apiGroup": "rbac.authorization.k8s.io", "kind": "User", "name": commands.CONTROLLERS_USER}],
}
"""The controllers share one account here, so it may do what any of them does."""


class ControlPlane:
    """A control plane with data of its own; a context manager that starts and removes it.

    Attributes:
        folder: its data and certificates; gone after `stop()`.
        logs: the folder of the programs' logs (`*.log`).
        kubeconfig: for an administrator (group system:masters).
        binaries: where its programs are, kubectl among them.
        refused_crds: why, by file name; empty unless a CRD is wrong.
        started_in: seconds that each program took to be ready.
    """

    def __init__(
        self,
        binaries: Binaries | None = None,
        crds: Path | None = None,
        site: Site = LOOPBACK,
        logs: Path | None = None,
    ):
        """Prepare; nothing runs yet.

        Args:
            binaries: its programs.
            crds: the folder to install CRDs from.
            site: where it is to run.
            logs: a folder for the logs, which are kept; by default they go with its data.
        """
        self.binaries = binaries or ensure_binaries()
        self.crds = crds
        self.folder = Path(tempfile.mkdtemp(prefix="wayside-controlplane-"))
        remove_afterwards(self.folder)
        self.logs = logs or self.folder
        self.logs.mkdir(exist_ok=True, parents=True)
        self.kubeconfig = self.folder / "kubeconfig"
        self.refused_crds: Mapping[str, ApiError] = {}
        self.started_in: dict[str, float] = {}
        etcd_port, etcd_peer_port, api_port = free_ports(3)
        self._setup = commands.Setup(self.binaries, self.folder, etcd_port, etcd_peer_port, api_port, site)
        self._token, self._controllers_token = new_token(), new_token()
        self._etcd: Child | None = None
        self._api_server: Child | None = None
        self._controller_manager: Child | None = None

    def __getstate__(self) -> dict[str, object]:
        """A copy in another process is a way to what runs here: it can neither stop nor restart it."""
        return self.__dict__ | {"_etcd": None, "_api_server": None, "_controller_manager": None}

    @property
    def url(self) -> str:
        """Where the API server listens; the same after a restart."""
        return f"https://{self._setup.site.address}:{self._setup.api_port}"

    @property
    def controller_manager(self) -> Child | None:
        """The one that runs now."""
        return self._controller_manager

    def pids(self) -> list[int]:
        """The process ids of what runs now."""
        children = (self._etcd, self._api_server, self._controller_manager)
        return [child.pid for child in children if child is not None]

    def api(self, namespace: str = "default") -> Api:
        """Return an administrator's client whose default namespace is `namespace`."""
        return Api(self.kubeconfig, namespace)

    def start(self) -> None:
        """Start all and wait until each is ready.

        Raises:
            TimeoutError: one is not; the message has the end of its log.
        """
        try:
            commands.write_tokens(self._setup, self._token, self._controllers_token)
            self._etcd = self._start_etcd()
            self.start_api_server()
            if self.crds is not None:
                self.refused_crds = apply_crds(self.api(), self.crds)
            self.start_controller_manager()
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """Kill all and remove the data: nobody needs it any more, so there is nothing to wait for."""
        for child in (self._controller_manager, self._api_server, self._etcd):
            if child is not None:
                child.kill9()
        self._controller_manager = self._api_server = self._etcd = None
        shutil.rmtree(self.folder, ignore_errors=True)

    def _start_etcd(self) -> Child:
        # Not waited for: the API server does so itself, and starts loading meanwhile.
        return self._child("etcd", commands.etcd(self._setup))

    def _child(self, name: str, command: list[str]) -> Child:
        return Child(name, [*self._setup.site.enter, *command], self.logs / f"{name}.log")

    def start_api_server(self) -> None:
        """Start the API server, on the same port and data as before, and wait until it is ready.

        A controller manager that lost the API server is restarted: its watches back off for up to 30 s each, and
        after an outage of 20 s it took 49 s until a Deployment had pods. That is Kubernetes' matter, not what we test.
        """
        began = time.monotonic()
        child = self._api_server = self._child("kube-apiserver", commands.kube_apiserver(self._setup))
        # It writes the key after the certificate: once the one is there, the other one is whole.
        self._wait(child, self._setup.serving_key.exists, "kube-apiserver has its certificate and key")
        write_kubeconfig(self.kubeconfig, self.url, self._setup.serving_certificate.read_bytes(), self._token)
        api = self.api()
        self._wait(child, lambda: api.raw("/readyz") == "ok", "kube-apiserver answers ok on /readyz")
        self.started_in["kube-apiserver"] = time.monotonic() - began
        if self._controller_manager is not None:
            self.stop_controller_manager()
            self.start_controller_manager()

    def stop_api_server(self) -> None:
        """Kill the API server, as a failure of its machine does: connections break, the data stays in etcd."""
        assert self._api_server is not None, "the API server does not run"
        self._api_server.kill9()
        self._api_server = None

    def recover(self) -> None:
        """Restart programs that a failed test left stopped, so that the next test is not affected."""
        if self._api_server is None or not self._api_server.alive:
            self.start_api_server()
        if self._controller_manager is None or not self._controller_manager.alive:
            self.start_controller_manager()

    @contextmanager
    def outage(self) -> Iterator[None]:
        """Keep the API server away for the duration of the block; after it, all works again."""
        self.stop_api_server()
        try:
            yield
        finally:
            self.start_api_server()

    def start_controller_manager(self) -> None:
        """Start the controller manager and wait until it serves a new namespace."""
        began = time.monotonic()
        certificate = self._setup.serving_certificate.read_bytes()
        write_kubeconfig(self._setup.controllers_kubeconfig, self.url, certificate, self._controllers_token)
        self.api().apply(_CONTROLLERS_RIGHTS)
        command = commands.kube_controller_manager(self._setup)
        child = self._controller_manager = self._child("kube-controller-manager", command)
        probe = f"probe-{secrets.token_hex(3)}"
        api = self.api(probe)
        namespace = {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": probe}}
        self._wait(child, lambda: bool(api.apply(namespace)), f"kube-apiserver takes the namespace {probe}")
        what = f"kube-controller-manager made the service account of the new namespace {probe}"
        self._wait(child, lambda: api.find("ServiceAccount", "default") is not None, what)
        api.delete("Namespace", probe)
        self.started_in["kube-controller-manager"] = time.monotonic() - began

    def stop_controller_manager(self) -> None:
        """Kill the controller manager."""
        assert self._controller_manager is not None, "the controller manager does not run"
        self._controller_manager.kill9()
        self._controller_manager = None

    def kubectl(self, *arguments: str) -> str:
        """Run kubectl as the administrator and return its stdout.

        Raises:
            RuntimeError: it failed; with its stderr.
        """
        command = [str(self.binaries.kubectl), f"--kubeconfig={self.kubeconfig}", *arguments]
        # What it remembers of an API server goes by the port, which another run's may have had.
        environment = os.environ | {"KUBECACHEDIR": str(self.folder / "kubectl")}
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=2 * PATIENCE, check=False
        )
        if done.returncode != 0:
            raise RuntimeError(f"kubectl {' '.join(arguments)}: exit code {done.returncode}\n{done.stderr}")
        return done.stdout

    def kubeconfig_with_token(self, name: str, token: str) -> Path:
        """Write a kubeconfig for the owner of the token and return its path; `name` names the file."""
        path = self.folder / f"kubeconfig-{name}"
        write_kubeconfig(path, self.url, self._setup.serving_certificate.read_bytes(), token)
        return path

    def kubeconfig_of_service_account(self, namespace: str, name: str) -> Path:
        """Return the path of a kubeconfig for a service account, valid for an hour: what RBAC allows it, no more."""
        request = {
            "apiVersion": "authentication.k8s.io/v1",
            "kind": "TokenRequest",
            "spec": {"expirationSeconds": 3600},
        }
        answer = self.api(namespace).post("ServiceAccount", name, "token", request)
        return self.kubeconfig_with_token(f"{namespace}-{name}", str(answer["status"]["token"]))

    def tails(self, lines: int = 40) -> str:
        """Return the ends of all logs, for messages."""
        return "\n".join(log_tail(log, lines) for log in sorted(self.logs.glob("*.log")))

    @property
    def processes(self) -> dict[str, int]:
        """The process id of each running program."""
        return {child.name: child.pid for child in self._children()}

    def memory(self) -> dict[str, int]:
        """Return the resident bytes of each running program."""
        return {child.name: child.resident_bytes() for child in self._children()}

    def _children(self) -> list[Child]:
        children = (self._etcd, self._api_server, self._controller_manager)
        return [child for child in children if child is not None]

    def _wait(self, child: Child, ready: Callable[[], bool], what: str) -> None:
        def look() -> bool:
            if not child.alive:
                raise RuntimeError(f"{child.name} ended instead of: {what}\n{self.tails()}")
            return ready()

        wait_until(look, bool, timeout=PATIENCE, what=what, transient=(Unreachable, ApiError), diagnose=self.tails)

    def __enter__(self) -> ControlPlane:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
