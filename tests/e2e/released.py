"""The chart as tests on the node install it: with a router that vehicles outside the cluster reach by mutual TLS."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import zenoh

from tests.certificates import Authority
from tests.cluster.api import Api
from tests.e2e.node import Node
from tests.patience import NODE_PATIENCE

RELEASE = "wayside"
MANAGER, ROUTER, DETECTOR = f"{RELEASE}-manager", f"{RELEASE}-router", "detector-town"
ROUTERS_PROGRAM = """
import sys, threading, zenoh
zenoh.init_log_from_env_or("error")
session = zenoh.open(zenoh.Config.from_file(sys.argv[2]))
threading.Event().wait()
"""
"""A router in place of the official Zenoh image, which cannot be pulled here: same library, same configuration."""
CLIENTS = [
    {"name": "vehicles", "commonNames": ["car1"], "publish": ["vehicles/{commonName}/**"]},
    {"name": "detectors", "commonNames": ["town"], "subscribe": ["vehicles/**"], "publish": ["wayside/**"]},
]


def image_values(image: str) -> dict[str, Any]:
    """The chart value `image` for an image that is already on the node."""
    repository, _, tag = image.rpartition(":")
    return {"repository": repository, "tag": tag, "pullPolicy": "Never"}


def values(namespace: str, image: str, detector: Mapping[str, Any]) -> dict[str, Any]:
    """A manager of this namespace, the router, and a Detector `town` with the spec `detector` that connects to it."""
    reached = {"mode": "client", "connect": [f"tls/{ROUTER}:7447"], "tlsSecretName": "town-tls"}
    return {
        "image": image_values(image),
        "manager": {"namespaces": [namespace]},
        "detectors": [{"name": "town", "spec": {**detector, "zenoh": reached}}],
        "router": {
            "enabled": True,
            "image": image_values(image),
            "command": ["python3", "-c", ROUTERS_PROGRAM],
            "service": {"type": "NodePort"},
            "tls": {"secretName": "router-tls"},
            "accessControl": {"clients": CLIENTS},
        },
    }


def apply_certificates(api: Api, authority: Authority) -> None:
    """Apply the Secrets that the values refer to."""
    for who, host in (("router", ROUTER), ("town", "town")):
        certificate, key = authority.sign(who, host)
        files = {"ca.crt": authority.ca, "tls.crt": certificate, "tls.key": key}
        data = {name: base64.b64encode(path.read_bytes()).decode() for name, path in files.items()}
        api.apply({"apiVersion": "v1", "kind": "Secret", "metadata": {"name": f"{who}-tls"}, "data": data})


def wait_installed(api: Api) -> None:
    """Wait until the manager, the router and the detector are available."""
    for name in (MANAGER, ROUTER, DETECTOR):
        api.wait_for("Deployment", name, available, timeout=NODE_PATIENCE, what=f"{name} is available")


def available(found: dict[str, Any]) -> bool:
    """Whether all pods of a Deployment are ready and match its current spec."""
    status, wanted = found.get("status", {}), found["spec"]["replicas"]
    seen = status.get("observedGeneration") == found["metadata"]["generation"]
    return bool(seen and status.get("updatedReplicas") == status.get("availableReplicas") == wanted)


def router_endpoint(node: Node, api: Api) -> str:
    """The endpoint at which the machine reaches the router."""
    port = api.get("Service", ROUTER)["spec"]["ports"][0]["nodePort"]
    return f"tls/{node.address}:{port}"


def vehicle(
    endpoint: str, authority: Path, certificate: tuple[Path, Path] | None, *, patience: float = NODE_PATIENCE
) -> zenoh.Session:
    """A vehicle's session from outside. Raises zenoh.ZError if the router rejects it for `patience` seconds."""
    tls: dict[str, Any] = {"root_ca_certificate": str(authority), "verify_name_on_connect": False}
    if certificate is not None:
        tls |= {"connect_certificate": str(certificate[0]), "connect_private_key": str(certificate[1])}
        tls["enable_mtls"] = True
    settings = {
        "mode": "client",
        "connect": {"endpoints": [endpoint], "timeout_ms": round(patience * 1000), "exit_on_failure": True},
        "scouting": {"multicast": {"enabled": False}},
        "transport": {"link": {"tls": tls}},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
