"""The account's token is renewed on a real API server, which no longer accepts the old one."""

from __future__ import annotations

import asyncio
import base64
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import yaml
from kubernetes.aio.client import Configuration

from application_manager.cluster.client import manager_client
from tests.cluster.api import Api
from tests.cluster.controlplane import ControlPlane
from tests.patience import PATIENCE
from wayside.kubernetes.connection import use_pod_account
from wayside.kubernetes.errors import ApiError
from wayside.kubernetes.resources import LEASES


def test_a_rejected_token_is_replaced_by_the_new_one_of_the_file(
    api: Api, namespace: str, control_plane: ControlPlane, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    api.create({"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": "manager"}})
    role = {"apiVersion": "rbac.authorization.k8s.io/v1", "metadata": {"name": "manager"}}
    rules = [{"apiGroups": ["coordination.k8s.io"], "resources": ["leases"], "verbs": ["list"]}]
    api.create({**role, "kind": "Role", "rules": rules})
    subjects = [{"kind": "ServiceAccount", "namespace": namespace, "name": "manager"}]
    reference = {"apiGroup": "rbac.authorization.k8s.io", "kind": "Role", "name": "manager"}
    api.create({**role, "kind": "RoleBinding", "subjects": subjects, "roleRef": reference})

    def bound(secret: str) -> str:
        """A token that is valid as long as the Secret exists."""
        made = api.create({"apiVersion": "v1", "kind": "Secret", "metadata": {"name": secret}})
        to = {"apiVersion": "v1", "kind": "Secret", "name": secret, "uid": made["metadata"]["uid"]}
        request = {"apiVersion": "authentication.k8s.io/v1", "kind": "TokenRequest", "spec": {"boundObjectRef": to}}
        return str(api.post("ServiceAccount", "manager", "token", request)["status"]["token"])

    where = urlsplit(control_plane.url)
    monkeypatch.setenv("KUBERNETES_SERVICE_HOST", str(where.hostname))
    monkeypatch.setenv("KUBERNETES_SERVICE_PORT", str(where.port))
    cluster = yaml.safe_load(control_plane.kubeconfig.read_text())["clusters"][0]["cluster"]
    (tmp_path / "ca.crt").write_bytes(base64.b64decode(cluster["certificate-authority-data"]))
    (tmp_path / "token").write_text(bound("first"))

    async def scenario() -> None:
        configuration = Configuration()
        use_pod_account(configuration, tmp_path)
        client = manager_client(configuration)

        async def until(*, taken: bool) -> None:
            async with asyncio.timeout(PATIENCE):
                while True:
                    try:
                        await client.list(LEASES, namespace)
                        found = True
                    except ApiError as error:
                        if error.code not in (401, 403):
                            raise
                        found = error.code == 403  # the token is accepted; the role is not in force yet
                    if found is taken:
                        return
                    await asyncio.sleep(0.1)

        try:
            await until(taken=True)
            api.delete("Secret", "first")
            await until(taken=False)
            (tmp_path / "token").write_text(bound("second"))
            await until(taken=True)
        finally:
            await client.close()

    asyncio.run(scenario())
