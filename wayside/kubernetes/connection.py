"""Finding the API server: a kubeconfig, or the pod's own account."""

from __future__ import annotations

import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kubernetes.aio.client import ApiClient, Configuration
from kubernetes.aio.config import ConfigException, load_kube_config
from yaml import YAMLError

from wayside.inputerror import InputError
from wayside.kubernetes.client import Client
from wayside.kubernetes.podaccount import AccountError, pod_namespace, use_pod_account

_CONNECTIONS = 32
_TIMEOUT = 10.0  # s for one request
_DEFAULT_FILE = "~/.kube/config"
_REMEDY = "set KUBECONFIG to a kubeconfig file, or run in a pod with a service account"
_BROKEN = (ConfigException, OSError, YAMLError, ValueError, TypeError, KeyError, AttributeError)
"""What the loader stumbles over in files that are no text, no YAML or of another shape: it checks little itself."""

# The package claims to be typed, yet these are not.
_load_kube_config: Any = load_kube_config
_ApiClient: Any = ApiClient


class ConfigurationError(InputError):
    """There is no usable kubeconfig, or the cluster lacks what the program needs."""


@dataclass(frozen=True)
class ApiAccess:
    """Where the API server is, with the account, and the account's own namespace."""

    configuration: Configuration
    namespace: str


async def load_access(kubeconfig: Path | None = None, otherwise: str = "") -> ApiAccess:
    """The kubeconfig of KUBECONFIG; in a pod without it, the pod's account; else that of the default file.

    Args:
        kubeconfig: a file in place of these.
        otherwise: what else the user can do where there is none; the error's text ends with it.

    Raises:
        ConfigurationError: there is none that can be used; the message names the file and what is wrong with it.
    """
    remedy = f"{_REMEDY}; or {otherwise}" if otherwise else _REMEDY
    configuration = Configuration()
    configuration.connection_pool_maxsize = _CONNECTIONS
    given = str(kubeconfig or "") or os.environ.get("KUBECONFIG")
    if not given and "KUBERNETES_SERVICE_HOST" in os.environ:
        try:
            use_pod_account(configuration)
            return ApiAccess(configuration, pod_namespace() or "default")
        except AccountError as error:
            raise ConfigurationError(f"the pod's service account: {error}: mount its token, or {remedy}") from error
    written = (given or _DEFAULT_FILE).split(os.pathsep)
    shown, files = ", ".join(written), [Path(each).expanduser() for each in written]  # noqa: ASYNC240  at the start
    if not any(each.is_file() for each in files):
        raise ConfigurationError(f"kubeconfig {shown}: there is no such file: {remedy}")
    try:
        # Given here, since the library reads the variable when it is imported.
        loader = await _load_kube_config(
            config_file=os.pathsep.join(map(str, files)), client_configuration=configuration, persist_config=False
        )
        await _ApiClient(configuration).close()  # reads the certificates that the file names
        return ApiAccess(configuration, str(loader.current_context.get("context", {}).get("namespace") or "default"))
    except _BROKEN as error:
        raise ConfigurationError(f"kubeconfig {shown}: {_reason(error)}: correct the file, or {remedy}") from error


async def load_configuration() -> Configuration:
    """The configuration of `load_access`. Raises ConfigurationError."""
    return (await load_access()).configuration


@dataclass(frozen=True)
class Cluster:
    """A connection and the namespace that it is meant for."""

    client: Client
    namespace: str


@asynccontextmanager
async def connect(
    program: str, namespace: str | None = None, kubeconfig: Path | None = None, *, otherwise: str = ""
) -> AsyncIterator[Cluster]:
    """The one connection that all parts of a program share. Nothing is sent yet: the server may be unavailable.

    Args:
        program: its name, also as field manager of what it writes.
        namespace: where to work. Default: the account's own.
        kubeconfig: see `load_access`.
        otherwise: see `load_access`.

    Raises:
        ConfigurationError: there is no API server, or its access cannot be read.
    """
    access = await load_access(kubeconfig, otherwise)
    client = Client(access.configuration, program, field_manager=program, timeout=_TIMEOUT)
    try:
        yield Cluster(client, namespace or access.namespace)
    finally:
        await client.close()


def _reason(error: BaseException) -> str:
    """Why the file cannot be used, in one line."""
    if isinstance(error, UnicodeDecodeError):
        return "it is not UTF-8 text"
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror or error}"
    if isinstance(error, YAMLError):
        return "it is not YAML: " + " ".join(str(error).split())
    if isinstance(error, ConfigException):
        return str(error)
    return f"it is not a kubeconfig ({type(error).__name__}: {error})"
