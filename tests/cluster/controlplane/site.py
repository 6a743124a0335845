"""Where a control plane runs: on the machine's loopback without nodes, or inside a node's own network."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Site:
    """The settings that differ between the places.

    Attributes:
        address: that the API server listens on.
        enter: what to put before a command line, so that it runs there.
        users: beside the administrator, who may come: name, group, token.
        api_server: further flags of kube-apiserver.
        controller_manager: further flags of kube-controller-manager.
        runs_pods: whether there are nodes; then all controllers run.
    """

    address: str
    enter: tuple[str, ...] = ()
    users: tuple[tuple[str, str, str], ...] = ()
    api_server: tuple[str, ...] = ()
    controller_manager: tuple[str, ...] = ()
    runs_pods: bool = False


LOOPBACK = Site(
    "127.0.0.1",
    # A Service `kubernetes` with a loopback address would be refused anyway.
    api_server=("--endpoint-reconciler-type=none",),
)
