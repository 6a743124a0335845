"""The account of the pod that the program runs in: its token is a file that the kubelet replaces while we run.

The kubelet renews the token long before it ends (after 80 % of its life), and the API server may stop taking the old
one at any time. So the file is read again before a request that is made a second or more after the last reading.
"""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path
from typing import Any

from kubernetes.aio.client import Configuration

FOLDER = Path("/var/run/secrets/kubernetes.io/serviceaccount")
"""Where Kubernetes puts the account of a pod."""

_READ_EVERY = 1.0  # s

log = logging.getLogger(__name__)


class AccountError(Exception):
    """The pod's account is not there, or not whole; the message names what is missing."""


def use_pod_account(configuration: Configuration, folder: Path = FOLDER) -> None:
    """Have the configuration reach the API server as the pod's account, and follow its token.

    Raises AccountError where the environment or the folder lacks something.
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

    settings: Any = configuration  # whose type has no hook
    settings.refresh_api_key_hook = refresh


def pod_namespace(folder: Path = FOLDER) -> str:
    """The namespace of the pod; empty outside a pod."""
    file = folder / "namespace"
    return file.read_text().strip() if file.is_file() else ""


class _Token:
    """The token, as it was read last."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._token = ""
        self._read_at = 0.0
        self._reported = False

    def read(self) -> str:
        """The token. Raises AccountError where there is none."""
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
        """The token, read again if it is time; the last one while the file cannot be read, which is logged once."""
        if time.monotonic() - self._read_at < _READ_EVERY:
            return self._token
        try:
            return self.read()
        except AccountError as error:
            if not self._reported:
                log.warning("cannot read the token of the pod's service account: %s; using the previous token", error)
            self._reported = True
            return self._token
