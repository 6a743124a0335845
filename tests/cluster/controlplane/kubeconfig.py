"""Credentials for the control plane of a test: a bearer token and the certificate to trust."""

from __future__ import annotations

import base64
import secrets
from pathlib import Path

import yaml


def new_token() -> str:
    """Return a random bearer token."""
    return secrets.token_urlsafe(32)


def write_kubeconfig(path: Path, url: str, certificate_authority: bytes, token: str) -> None:
    """Write a kubeconfig with one user, readable by this user alone.

    Args:
        path: the file.
        url: of the API server.
        certificate_authority: PEM.
        token: of the user.
    """
    content = {
        "apiVersion": "v1",
        "kind": "Config",
        "current-context": "wayside-test",
        "contexts": [{"name": "wayside-test", "context": {"cluster": "wayside-test", "user": "wayside-test"}}],
        "clusters": [
            {
                "name": "wayside-test",
                "cluster": {
                    "server": url,
                    "certificate-authority-data": base64.b64encode(certificate_authority).decode(),
                },
            }
        ],
        "users": [{"name": "wayside-test", "user": {"token": token}}],
    }
    unfinished = path.with_suffix(".new")  # a program that starts meanwhile must not read half of it
    unfinished.touch(mode=0o600)
    unfinished.write_text(yaml.safe_dump(content))
    unfinished.rename(path)
