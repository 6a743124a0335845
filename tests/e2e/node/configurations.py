"""The configurations of a node's programs."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import yaml

from tests.e2e.images import SANDBOX_IMAGE

PODS = "10.244.0.0/24"  # visible only inside the enclosure, like the Services' 10.96.0.0/16
DOMAIN = "cluster.local"


@dataclass(frozen=True)
class Paths:
    """The paths of the node's files, below its state folder."""

    folder: Path

    @property
    def socket(self) -> Path:
        """containerd's."""
        return self.folder / "containerd.sock"

    @property
    def kubelet(self) -> Path:
        """The data folder of kubelet; its configuration is `kubelet.yaml` beside it."""
        return self.folder / "kubelet"


def containerd(paths: Paths, programs: Path) -> str:
    """Return config.toml of containerd; `programs` has the network plugins."""
    return f"""\
version = 3
root = "{paths.folder}/containerd"
state = "/run/containerd"
disabled_plugins = ["io.containerd.internal.v1.opt", "io.containerd.nri.v1.nri"]
[grpc]
  address = "{paths.socket}"
[plugins.'io.containerd.cri.v1.images'.pinned_images]
  sandbox = "{SANDBOX_IMAGE}"
[plugins.'io.containerd.cri.v1.runtime']
  restrict_oom_score_adj = true  # else runc dies where the parent's own score may not be lowered
[plugins.'io.containerd.cri.v1.runtime'.cni]
  bin_dirs = ["{programs}"]
  conf_dir = "{paths.folder}/cni"
[plugins.'io.containerd.cri.v1.runtime'.containerd.runtimes.runc]
  runtime_type = "io.containerd.runc.v2"
[plugins.'io.containerd.cri.v1.runtime'.containerd.runtimes.runc.options]
  BinaryName = "runc"
  SystemdCgroup = false
"""


def network() -> str:
    """Return the network of the pods: a bridge, whose allocated addresses are in files."""
    bridge = {
        "type": "bridge",
        "bridge": "pods",
        "isGateway": True,
        "ipMasq": True,
        "hairpinMode": True,
        "ipam": {"type": "host-local", "ranges": [[{"subnet": PODS}]], "routes": [{"dst": "0.0.0.0/0"}]},
    }
    return json.dumps({"cniVersion": "1.0.0", "name": "pods", "plugins": [bridge]})


def kubelet(paths: Paths, address: str, cgroup: str, client_authority: Path, sync: str) -> str:
    """Return the KubeletConfiguration; `sync`: how often it looks at each pod by itself."""
    return yaml.safe_dump(
        {
            "apiVersion": "kubelet.config.k8s.io/v1beta1",
            "kind": "KubeletConfiguration",
            "address": address,
            "authentication": {
                "anonymous": {"enabled": False},
                "webhook": {"enabled": True},
                "x509": {"clientCAFile": str(client_authority)},
            },
            "authorization": {"mode": "Webhook"},
            "containerRuntimeEndpoint": f"unix://{paths.socket}",
            "podLogsDir": str(paths.folder / "pods"),
            "cgroupDriver": "cgroupfs",
            "cgroupRoot": cgroup,
            "enforceNodeAllocatable": [],
            "failCgroupV1": False,
            "failSwapOn": False,
            "clusterDNS": [address],
            "clusterDomain": DOMAIN,
            "resolvConf": "",
            "healthzBindAddress": "127.0.0.1",
            "readOnlyPort": 0,
            "evictionHard": {"memory.available": "1%", "nodefs.available": "1%", "imagefs.available": "1%"},
            "imageGCHighThresholdPercent": 100,
            "syncFrequency": sync,
            "nodeStatusUpdateFrequency": "5s",
            "registerNode": True,
        }
    )


def kube_proxy(kubeconfig: Path, address: str) -> str:
    """Return the KubeProxyConfiguration: it sets no limits of connection tracking, which apply to the whole machine."""
    return yaml.safe_dump(
        {
            "apiVersion": "kubeproxy.config.k8s.io/v1alpha1",
            "kind": "KubeProxyConfiguration",
            "mode": "iptables",
            "bindAddress": address,
            "hostnameOverride": "node",
            "clusterCIDR": PODS,
            "clientConnection": {"kubeconfig": str(kubeconfig)},
            "healthzBindAddress": "127.0.0.1:10256",
            "conntrack": {
                "maxPerCore": 0,
                "min": 0,
                "tcpEstablishedTimeout": "0s",
                "tcpCloseWaitTimeout": "0s",
            },
            "iptables": {"syncPeriod": "10s", "minSyncPeriod": "0s"},
        }
    )


def corefile(kubeconfig: Path, address: str) -> str:
    """Return the configuration of CoreDNS: the cluster's names and no others."""
    return f"""\
{DOMAIN}:53 in-addr.arpa:53 {{
    bind {address}
    errors
    kubernetes {DOMAIN} in-addr.arpa {{
        kubeconfig {kubeconfig}
        ttl 5
    }}
}}
"""
