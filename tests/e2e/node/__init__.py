"""A real cluster of one node: the control plane of the cluster tests, and the programs that run pods.

API server, etcd, controller manager, scheduler, kubelet, kube-proxy, containerd and CoreDNS are processes inside one
enclosure (see `enclosure`), so the API server reaches pods, and their changes to the machine end with them. The
machine reaches the node at its address: the API server, NodePorts, and nothing else.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType

from tests.certificates import Authority
from tests.cluster.api import Api, ApiError, Unreachable
from tests.cluster.binaries import Binaries, ensure_binaries
from tests.cluster.children import Child, remove_afterwards
from tests.cluster.controlplane import ControlPlane
from tests.cluster.controlplane.kubeconfig import new_token
from tests.cluster.controlplane.site import Site
from tests.cluster.waiting import wait_until
from tests.e2e.images import pause_archive
from tests.e2e.node import configurations
from tests.e2e.node.enclosure import Enclosure
from tests.e2e.programs import Programs, ensure_programs
from tests.patience import NODE_PATIENCE

NAME = "node"
USERS = {  # the names that Kubernetes' own roles are bound to
    "kubelet": (f"system:node:{NAME}", "system:nodes"),
    "kube-proxy": ("system:kube-proxy", ""),
    "kube-scheduler": ("system:kube-scheduler", ""),
    "coredns": ("coredns", ""),
}
SHIM = "containerd-shim"  # a prefix of its name: the parent process of a pod's containers, which outlives containerd
TO_KUBELET = "apiserver-to-kubelet"


class Node:
    """A cluster of one node; a context manager that starts and removes it.

    Attributes:
        folder: its data and logs; `stop()` removes it.
        plane: the control plane, with the kubeconfig of an administrator.
        started_in: the duration of each step of the start, in seconds.
    """

    def __init__(
        self,
        binaries: Binaries | None = None,
        programs: Programs | None = None,
        crds: Path | None = None,
        *,
        sync: str = "10s",
    ):
        """Prepare; nothing runs yet.

        Args:
            binaries: of the control plane.
            programs: of the node.
            crds: the folder to install CRDs from.
            sync: how often the kubelet looks at each pod by itself. Its own default is `1m`.
        """
        self.binaries = binaries or ensure_binaries()
        self.programs = programs or ensure_programs()
        self.crds = crds
        self.sync = sync
        self.folder = Path(tempfile.mkdtemp(prefix="wayside-e2e-"))
        remove_afterwards(self.folder)
        self.enclosure = Enclosure(self.folder)
        self.started_in: dict[str, float] = {}
        self._paths = configurations.Paths(self.folder)
        self._tokens = {name: new_token() for name in USERS}
        self._children: dict[str, Child] = {}
        self._plane: ControlPlane | None = None

    @property
    def plane(self) -> ControlPlane:
        """The control plane of the running node."""
        assert self._plane is not None, "the node does not run"
        return self._plane

    @property
    def address(self) -> str:
        """The address at which the machine reaches the API server and NodePorts."""
        return self.enclosure.inside

    def api(self, namespace: str = "default") -> Api:
        """Return an administrator's client whose default namespace is `namespace`."""
        return self.plane.api(namespace)

    def start(self) -> None:
        """Start all and wait until the node is ready. Raises TimeoutError with the log of a program that is not."""
        try:
            self._timed("enclosure", self.enclosure.open)
            self._timed("containerd", self.start_containerd)
            self.load(pause_archive(self.programs.pause, self.folder))
            self._timed("control plane", self._start_plane)
            self._timed("node", self._start_node)
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """Kill all and remove the data."""
        if self._plane is not None:
            self._plane.stop()
        for child in reversed(self._children.values()):
            child.kill9()
        self._children = {}
        self._plane = None
        self.enclosure.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def start_containerd(self) -> None:
        """Start containerd and wait until it answers."""
        (self.folder / "cni").mkdir(exist_ok=True)
        (self.folder / "cni" / "10-pods.conflist").write_text(configurations.network())
        file = self.folder / "containerd.toml"
        file.write_text(configurations.containerd(self._paths, self.programs.containers))
        child = self._start("containerd", str(self.programs.containers / "containerd"), f"--config={file}")

        def answers() -> bool:
            self._alive(child)
            return "Server:" in self.ctr("version")

        error = (_CommandError,)
        what = "containerd answers"
        wait_until(answers, bool, timeout=NODE_PATIENCE, what=what, transient=error, diagnose=child.tail)

    def start_kubelet(self) -> None:
        """Start kubelet; it does not wait for the node to be ready."""
        authority = self.folder / "authority.crt"
        file = self.folder / "kubelet.yaml"
        file.write_text(configurations.kubelet(self._paths, self.address, self.enclosure.cgroup, authority, self.sync))
        self._start(
            "kubelet",
            str(self.programs.node / "kubelet"),
            f"--config={file}",
            f"--kubeconfig={self._kubeconfig('kubelet')}",
            f"--root-dir={self._paths.kubelet}",
            f"--hostname-override={NAME}",
            f"--node-ip={self.address}",
        )

    def wait_ready(self) -> None:
        """Wait until the node accepts pods."""

        def ready() -> bool:
            for child in self._children.values():
                self._alive(child)
            found = self.api().find("Node", NAME)
            conditions = {
                each["type"]: each["status"] for each in (found or {}).get("status", {}).get("conditions", [])
            }
            return conditions.get("Ready") == "True" and not (found or {})["spec"].get("taints")

        wait_until(
            ready,
            bool,
            timeout=NODE_PATIENCE,
            what="the node is ready",
            transient=(Unreachable, ApiError),
            diagnose=self._children["kubelet"].tail,
        )

    def stop_program(self, name: str) -> None:
        """Kill `containerd`, `kubelet`, `kube-proxy`, `kube-scheduler` or `coredns`; pods keep running."""
        self._children.pop(name).kill9()

    def power_off(self) -> None:
        """Kill all processes of the node, pods and the API server too, as a power cut does; disks keep their data."""
        for name in reversed(tuple(self._children)):
            self.stop_program(name)
        self.enclosure.kill(SHIM)
        self.plane.stop_api_server()

    def power_on(self) -> None:
        """Start the programs that `power_off` killed and wait until the node is ready; kubelet restarts the pods."""
        self.start_containerd()
        self.plane.start_api_server()
        self._start_node()

    def ctr(self, *arguments: str) -> str:
        """Run containerd's command line for the images and containers of Kubernetes; return its stdout."""
        command = [str(self.programs.containers / "ctr"), f"--address={self._paths.socket}", "--namespace=k8s.io"]
        try:
            return self.enclosure.run(*command, *arguments, path=self.programs.path)
        except RuntimeError as error:
            raise _CommandError(str(error)) from error

    def load(self, archive: Path) -> list[str]:
        """Import the images of an OCI archive; return their names."""
        self.ctr("images", "import", "--no-unpack=false", str(archive))
        return sorted(self.ctr("images", "list", "--quiet").split())

    def tails(self, lines: int = 40) -> str:
        """Return the ends of all logs, for messages."""
        own = [child.tail(lines) for child in self._children.values()]
        return "\n".join([*own, self._plane.tails(lines) if self._plane else ""])

    def _start_plane(self) -> None:
        authority = Authority(self.folder)
        certificate, key = authority.sign(TO_KUBELET)
        site = Site(
            address=self.address,
            enter=self.enclosure.enter,
            users=tuple((name, group, self._tokens[program]) for program, (name, group) in USERS.items()),
            api_server=(
                "--enable-aggregator-routing=true",  # webhooks go to pods, not to Services' addresses
                f"--kubelet-client-certificate={certificate}",  # logs and exec
                f"--kubelet-client-key={key}",
                "--kubelet-preferred-address-types=InternalIP",
            ),
            runs_pods=True,
        )
        self._plane = ControlPlane(self.binaries, self.crds, site)
        self._plane.start()
        self._allow(TO_KUBELET, "system:kubelet-api-admin")
        self.api().apply(
            {
                "apiVersion": "rbac.authorization.k8s.io/v1",
                "kind": "ClusterRole",
                "metadata": {"name": "coredns"},
                "rules": [
                    {"apiGroups": [""], "resources": ["services", "namespaces", "pods"], "verbs": ["list", "watch"]},
                    {"apiGroups": ["discovery.k8s.io"], "resources": ["endpointslices"], "verbs": ["list", "watch"]},
                ],
            }
        )
        self._allow("coredns", "coredns")

    def _allow(self, user: str, role: str) -> None:
        group = "rbac.authorization.k8s.io"
        self.api().apply(
            {
                "apiVersion": f"{group}/v1",
                "kind": "ClusterRoleBinding",
                "metadata": {"name": user},
                "roleRef": {"apiGroup": group, "kind": "ClusterRole", "name": role},
                "subjects": [{"apiGroup": group, "kind": "User", "name": user}],
            }
        )

    def _start_node(self) -> None:
        self.start_kubelet()
        programs = self.programs.node
        scheduler = self._kubeconfig("kube-scheduler")
        self._start(
            "kube-scheduler",
            str(self.binaries.kube_scheduler),
            f"--kubeconfig={scheduler}",
            f"--authentication-kubeconfig={scheduler}",
            f"--authorization-kubeconfig={scheduler}",
            "--leader-elect=false",
            "--bind-address=127.0.0.1",
        )
        file = self.folder / "kube-proxy.yaml"
        file.write_text(configurations.kube_proxy(self._kubeconfig("kube-proxy"), self.address))
        self._start("kube-proxy", str(programs / "kube-proxy"), f"--config={file}")
        corefile = self.folder / "Corefile"
        corefile.write_text(configurations.corefile(self._kubeconfig("coredns"), self.address))
        self._start("coredns", str(self.programs.coredns), "-conf", str(corefile))
        self.wait_ready()

    def _start(self, name: str, *command: str) -> Child:
        environment: Mapping[str, str] = {"PATH": self.programs.path}
        child = self._children[name] = self.enclosure.start(name, command, environment)
        return child

    def _kubeconfig(self, program: str) -> Path:
        return self.plane.kubeconfig_with_token(program, self._tokens[program])

    def _alive(self, child: Child) -> None:
        if not child.alive:
            raise RuntimeError(f"{child.name} ended\n{child.tail()}")

    def _timed(self, name: str, step: Callable[[], None]) -> None:
        began = time.monotonic()
        step()
        self.started_in[name] = time.monotonic() - began

    def __enter__(self) -> Node:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


class _CommandError(RuntimeError):
    """A command of containerd failed."""
