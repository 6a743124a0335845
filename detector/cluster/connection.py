"""Finds the API server and the detector's account: a kubeconfig, or the account of the pod."""

from __future__ import annotations

import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

from kubernetes.aio.client import ApiClient, Configuration
from kubernetes.aio.config import ConfigException, kube_config, load_incluster_config, load_kube_config
from yaml import YAMLError

from detector.cluster.api import Api
from detector.cluster.errors import NoClusterError

_OWN_NAMESPACE = Path("/var/run/secrets/kubernetes.io/serviceaccount/namespace")
_IN_CLUSTER = "KUBERNETES_SERVICE_HOST"
_CONNECTIONS = 32

_BROKEN = (ConfigException, OSError, YAMLError, ValueError, TypeError, KeyError, AttributeError)
"""What the loader raises for files that are missing, not YAML or malformed: it validates little itself."""


@dataclass(frozen=True)
class Cluster:
    """A connection and its default namespace."""

    api: Api
    namespace: str


@asynccontextmanager
async def connect(
    namespace: str | None = None, kubeconfig: Path | None = None, *, otherwise: str = ""
) -> AsyncIterator[Cluster]:
    """Set up the one connection that all parts share. Nothing is sent yet: the server may be unavailable.

    Args:
        namespace: where to work. Default: the kubeconfig context's, or the pod's own.
        kubeconfig: a file. Default: `KUBECONFIG`; in a pod without it, the pod's account; else `~/.kube/config`.
        otherwise: what else can be done where there is no API server; the error's text ends with it.

    Raises:
        NoClusterError: there is neither, or it cannot be read.
    """
    configuration = Configuration()
    configuration.connection_pool_maxsize = _CONNECTIONS
    try:
        found = await _load(configuration, kubeconfig)
        api = Api(ApiClient(configuration))
    except _BROKEN as error:
        raise NoClusterError(
            f"no API server: {error or type(error).__name__}. Set KUBECONFIG to a kubeconfig file, or run in a pod "
            "with a service account" + (f"; or {otherwise}" if otherwise else "")
        ) from error
    try:
        yield Cluster(api, namespace or found)
    finally:
        await api.close()


async def _load(configuration: Configuration, kubeconfig: Path | None) -> str:
    """Fill in the configuration; returns the default namespace."""
    if kubeconfig is None and "KUBECONFIG" not in os.environ and _IN_CLUSTER in os.environ:
        load_incluster_config(configuration)  # type: ignore[no-untyped-call]
        return _OWN_NAMESPACE.read_text().strip()  # noqa: ASYNC240  once, at the start
    file = str(kubeconfig) if kubeconfig else os.environ.get("KUBECONFIG", kube_config.KUBE_CONFIG_DEFAULT_LOCATION)
    loader = await load_kube_config(  # type: ignore[no-untyped-call]
        file, client_configuration=configuration, persist_config=False
    )
    return str(loader.current_context.get("context", {}).get("namespace") or "default")
