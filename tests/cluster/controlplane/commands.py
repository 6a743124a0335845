"""The command lines of the control plane, and why each flag is there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tests.cluster.binaries import Binaries
from tests.cluster.controlplane.site import LOOPBACK, Site


@dataclass(frozen=True)
class Setup:
    """The inputs of the command lines."""

    binaries: Binaries
    folder: Path
    etcd_port: int
    etcd_peer_port: int
    api_port: int
    site: Site = LOOPBACK

    @property
    def serving_certificate(self) -> Path:
        """PEM that kube-apiserver writes at its first start: its certificate, then the CA that signed it."""
        return self.folder / "certificates" / "apiserver.crt"

    @property
    def serving_key(self) -> Path:
        """The key of the certificate. It signs the service accounts' tokens as well: no other tool for keys needed."""
        return self.folder / "certificates" / "apiserver.key"

    @property
    def tokens(self) -> Path:
        """The accepted tokens: `token,user,uid,"group,…"` a line."""
        return self.folder / "tokens.csv"

    @property
    def kubeconfig(self) -> Path:
        """An administrator's."""
        return self.folder / "kubeconfig"

    @property
    def controllers_kubeconfig(self) -> Path:
        """The controller manager's."""
        return self.folder / "kubeconfig-controllers"


CONTROLLERS_USER = "system:kube-controller-manager"


def write_tokens(setup: Setup, administrator: str, controllers: str) -> None:
    """Write the file of the accounts that the API server accepts.

    The controller manager has a user of its own, as in any cluster: who is of the group system:masters goes past API
    Priority and Fairness.
    """
    setup.tokens.touch(mode=0o600)
    lines = [
        f'{administrator},administrator,administrator,"system:masters"',
        f"{controllers},{CONTROLLERS_USER},{CONTROLLERS_USER}",
    ]
    lines += [f'{token},{user},{user},"{group}"' for user, group, token in setup.site.users]
    setup.tokens.write_text("".join(f"{line}\n" for line in lines))


def etcd(setup: Setup) -> list[str]:
    """Return the command line of etcd."""
    client = f"http://127.0.0.1:{setup.etcd_port}"
    peer = f"http://127.0.0.1:{setup.etcd_peer_port}"
    return [
        str(setup.binaries.etcd),
        f"--data-dir={setup.folder / 'etcd'}",
        f"--listen-client-urls={client}",
        f"--advertise-client-urls={client}",
        f"--listen-peer-urls={peer}",
        f"--initial-advertise-peer-urls={peer}",
        f"--initial-cluster=default={peer}",
        "--unsafe-no-fsync",  # the data lives as long as the machine does, and fsync is most of a write's time
        "--log-level=warn",
    ]


def kube_apiserver(setup: Setup) -> list[str]:
    """Return the command line of kube-apiserver: its defaults, with as few exceptions as one machine needs."""
    return [
        str(setup.binaries.kube_apiserver),
        f"--etcd-servers=http://127.0.0.1:{setup.etcd_port}",
        f"--bind-address={setup.site.address}",
        f"--advertise-address={setup.site.address}",
        f"--secure-port={setup.api_port}",
        f"--cert-dir={setup.serving_certificate.parent}",
        f"--token-auth-file={setup.tokens}",
        "--authorization-mode=Node,RBAC",
        "--service-account-issuer=https://kubernetes.default.svc",
        f"--service-account-signing-key-file={setup.serving_key}",
        f"--service-account-key-file={setup.serving_key}",
        "--service-cluster-ip-range=10.96.0.0/16",
        *setup.site.api_server,
    ]


CONTROLLERS = (
    "deployment-controller",
    "replicaset-controller",
    "statefulset-controller",
    "daemonset-controller",
    "job-controller",
    "horizontal-pod-autoscaler-controller",
    "endpointslice-controller",
    "garbage-collector-controller",
    "namespace-controller",
    "resourcequota-controller",
    "serviceaccount-controller",
    "root-ca-certificate-publisher-controller",
    "clusterrole-aggregation-controller",
    "validatingadmissionpolicy-status-controller",
)


def kube_controller_manager(setup: Setup) -> list[str]:
    """Return the command line of kube-controller-manager: without nodes, the controllers that work so."""
    controllers = "*" if setup.site.runs_pods else ",".join(CONTROLLERS)
    return [
        str(setup.binaries.kube_controller_manager),
        f"--kubeconfig={setup.controllers_kubeconfig}",
        f"--controllers={controllers}",
        f"--root-ca-file={setup.serving_certificate}",
        "--horizontal-pod-autoscaler-sync-period=1s",  # 15 s by default, which tests would wait for
        "--leader-elect=false",  # it is alone, and a lease would delay its restart
        "--secure-port=0",
        "--kube-api-qps=1000",  # the default of 20 a second would be what a test of 100 Deployments measures
        "--kube-api-burst=2000",
        *setup.site.controller_manager,
    ]
