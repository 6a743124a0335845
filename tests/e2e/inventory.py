"""An inventory of a cluster, to find leftover objects."""

from __future__ import annotations

from tests.cluster.waiting import wait_until
from tests.e2e.node import Node

Found = tuple[str, str, str]  # kind, namespace, name

_TEMPLATE = '{range .items[*]}{.kind}{" "}{.metadata.namespace}{"/"}{.metadata.name}{"\\n"}{end}'
_NOT_COUNTED = {"APIService", "Event"}
"""The API server creates and removes an APIService for each API group of CRDs by itself; Events expire."""


def inventory(node: Node) -> set[Found]:
    """All objects of all listable kinds in all namespaces; lists again if a kind is removed meanwhile."""
    return wait_until(lambda: _listed(node), bool, what="all kinds can be listed", transient=(RuntimeError,))


def _listed(node: Node) -> set[Found]:
    served = node.plane.kubectl("api-resources", "--verbs=list", "--output=name").split()
    listed = node.plane.kubectl(
        "get", ",".join(sorted(served)), "--all-namespaces", "--ignore-not-found", f"--output=jsonpath={_TEMPLATE}"
    )
    found = set()
    for line in listed.splitlines():
        kind, _, place = line.partition(" ")
        namespace, _, name = place.partition("/")
        if kind not in _NOT_COUNTED:
            found.add((kind, namespace, name))
    return found


def wait_left(node: Node, before: set[Found], kinds: set[str], timeout: float) -> set[Found]:
    """Wait until all objects that are not in `before` are of `kinds`; return them. Raises TimeoutError with all."""
    return wait_until(
        lambda: _listed(node) - before,
        lambda new: {kind for kind, _, _ in new} <= kinds,
        timeout=timeout,
        what=f"the kinds of the new objects that remain are at most: {', '.join(sorted(kinds)) or 'none'}",
        transient=(RuntimeError,),  # a kind was removed between the discovery and the list
    )
