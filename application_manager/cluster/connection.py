"""Finding the API server: a kubeconfig, or the pod's own account."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from kubernetes.aio.client import ApiClient, Configuration
from kubernetes.aio.config import ConfigException, load_kube_config
from yaml import YAMLError

from application_manager.cluster.podaccount import AccountError, use_pod_account
from wayside.inputerror import InputError

_CONNECTIONS = 32
_DEFAULT_FILE = "~/.kube/config"
_REMEDY = "set KUBECONFIG to a kubeconfig file, or run in a pod with a service account"
_BROKEN = (ConfigException, OSError, YAMLError, ValueError, TypeError, KeyError, AttributeError)
"""What the loader stumbles over in files that are no text, no YAML or of another shape: it checks little itself."""

# The package claims to be typed, yet these are not.
_load_kube_config: Any = load_kube_config
_ApiClient: Any = ApiClient


class ConfigurationError(InputError):
    """There is no usable kubeconfig, or the cluster lacks what the manager needs."""


async def load_configuration() -> Configuration:
    """The kubeconfig of KUBECONFIG; in a pod without it, the pod's account; else that of the default file.

    Raises ConfigurationError, which names the file and what is wrong with it, where there is none that can be used.
    """
    configuration = Configuration()
    configuration.connection_pool_maxsize = _CONNECTIONS
    given = os.environ.get("KUBECONFIG")
    if not given and "KUBERNETES_SERVICE_HOST" in os.environ:
        try:
            use_pod_account(configuration)
        except AccountError as error:
            raise ConfigurationError(f"the pod's service account: {error}: mount its token, or {_REMEDY}") from error
        return configuration
    written = (given or _DEFAULT_FILE).split(os.pathsep)
    shown, files = ", ".join(written), [Path(each).expanduser() for each in written]  # noqa: ASYNC240  at the start
    if not any(each.is_file() for each in files):
        raise ConfigurationError(f"kubeconfig {shown}: there is no such file: {_REMEDY}")
    try:
        # Given here, since the library reads the variable when it is imported.
        await _load_kube_config(config_file=os.pathsep.join(map(str, files)), client_configuration=configuration)
        await _ApiClient(configuration).close()  # reads the certificates that the file names
    except _BROKEN as error:
        raise ConfigurationError(f"kubeconfig {shown}: {_reason(error)}: correct the file, or {_REMEDY}") from error
    return configuration


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
