"""Finds the API server and the credentials: a kubeconfig, or the pod's service account."""

from __future__ import annotations

import logging
import os
import time
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

FOLDER = Path("/var/run/secrets/kubernetes.io/serviceaccount")
"""The folder in which Kubernetes mounts the service account of a pod."""

_CONNECTIONS = 32
_TIMEOUT = 10.0  # s for one request
_READ_EVERY = 1.0  # s
_DEFAULT_FILE = "~/.kube/config"
_REMEDY = "set KUBECONFIG to a kubeconfig file, or run in a pod with a service account"
_BROKEN = (ConfigException, OSError, YAMLError, ValueError, TypeError, KeyError, AttributeError)
"""The errors of the loader for files that are not text, not YAML or have another structure: it checks little itself."""

# The package claims to be typed, yet these are not.
_load_kube_config: Any = load_kube_config
_ApiClient: Any = ApiClient

log = logging.getLogger(__name__)


class AccountError(Exception):
    """The pod's service account is missing or incomplete; the message names the missing part."""


class ConfigurationError(InputError):
    """There is no usable kubeconfig, or the cluster does not have what the program needs."""


@dataclass(frozen=True)
class ApiAccess:
    """The address of the API server with the credentials, and the namespace of the account."""

    configuration: Configuration
    namespace: str


async def load_access(kubeconfig: Path | None = None, otherwise: str = "") -> ApiAccess:
    """The access by KUBECONFIG; without it, by the service account in a pod, else by the default kubeconfig.

    Args:
        kubeconfig: a file to use instead of these.
        otherwise: another remedy for a missing kubeconfig; the error's text ends with it.

    Raises:
        ConfigurationError: there is no usable configuration; the message names the file and the problem.
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
        # Passed explicitly, since the library reads the variable at import.
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
    """A connection and its namespace."""

    client: Client
    namespace: str


@asynccontextmanager
async def connect(
    program: str, namespace: str | None = None, kubeconfig: Path | None = None, *, otherwise: str = ""
) -> AsyncIterator[Cluster]:
    """The one connection that all parts of a program share. Nothing is sent yet, so the server may be unavailable.

    Args:
        program: its name, also as the field manager of its writes.
        namespace: the namespace to work in. Default: that of the account.
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
    """The reason why the file cannot be used, in one line."""
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


def use_pod_account(configuration: Configuration, folder: Path = FOLDER) -> None:
    """Configure access with the pod's service account, and reload its token when it is renewed.

    Raises AccountError if a part of the environment or of the folder is missing.
    """
    host, port = (os.environ.get(f"KUBERNETES_SERVICE_{each}") or "" for each in ("HOST", "PORT"))
    if not host or not port:
        raise AccountError("KUBERNETES_SERVICE_HOST and KUBERNETES_SERVICE_PORT are not both set")
    authority = folder / "ca.crt"
    if not authority.is_file() or not authority.stat().st_size:
        raise AccountError(f"{authority} does not exist, or is empty")
    token = _Token(folder / "token")
    configuration.host = f"https://[{host}]:{port}" if ":" in host else f"https://{host}:{port}"
    configuration.ssl_ca_cert = str(authority)
    configuration.api_key["BearerToken"] = f"Bearer {token.read()}"

    def refresh(of: Configuration) -> None:
        of.api_key["BearerToken"] = f"Bearer {token.newest()}"

    settings: Any = configuration  # its type does not declare the hook
    settings.refresh_api_key_hook = refresh


def pod_namespace() -> str:
    """The namespace of the pod; empty outside a pod."""
    file = FOLDER / "namespace"
    return file.read_text().strip() if file.is_file() else ""


class _Token:
    """The token of the pod's service account, from a file that the kubelet replaces from time to time.

    The kubelet renews the token after 80 % of its lifetime, and the API server may reject the old one at any time. So a
    request that is sent a second or more after the last reading reads the file again.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._token = ""
        self._read_at = 0.0
        self._reported = False

    def read(self) -> str:
        """Read the token. Raises AccountError if there is none."""
        self._read_at = time.monotonic()
        try:
            found = self._file.read_text().strip()
        except OSError as error:
            raise AccountError(f"{self._file}: {error.strerror or error}") from error
        if not found:
            raise AccountError(f"{self._file} is empty")
        if self._token and found != self._token:
            log.info("read the renewed token of the pod's service account")
        self._token, self._reported = found, False
        return found

    def newest(self) -> str:
        """The token, read again if the last read is old; if that fails, which is logged once, the previous token."""
        if time.monotonic() - self._read_at < _READ_EVERY:
            return self._token
        try:
            return self.read()
        except AccountError as error:
            if not self._reported:
                log.warning("cannot read the token of the pod's service account: %s; using the previous token", error)
            self._reported = True
            return self._token
