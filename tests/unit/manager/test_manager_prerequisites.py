"""The manager refuses to start on a Kubernetes version on which it cannot release applications."""

from __future__ import annotations

import asyncio
from typing import cast

import pytest

from application_manager.running.prerequisites import check_version
from wayside.kubernetes.client import Client
from wayside.kubernetes.connection import ConfigurationError


class Server:
    """An API server of a version."""

    def __init__(self, version: str) -> None:
        self._version = version

    async def server_version(self) -> str:
        return self._version


def checked(version: str) -> str:
    return asyncio.run(check_version(cast("Client", Server(version))))


@pytest.mark.parametrize("version", ["v1.31.0", "v1.36.3-eks-1", "v1.31.9+k3s1", "v2.0.0", "of its own"])
def test_recent_and_unknown_versions_are_accepted(version: str) -> None:
    assert checked(version) == version


@pytest.mark.parametrize("version", ["v1.30.14", "v1.9.11", "v1.30.0-gke.1"])
def test_older_versions_are_rejected_with_the_reason_and_the_remedy(version: str) -> None:
    with pytest.raises(ConfigurationError, match=r"1\.31 or newer is required: .*upgrade the cluster") as refused:
        checked(version)
    assert version in str(refused.value)
