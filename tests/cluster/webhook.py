"""The webhook in tests: a manager with a certificate, and an API server that calls it for one namespace."""

from __future__ import annotations

import json
import os
import secrets
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from application_manager.admission.issuer import make_certificates
from application_manager.core.findings.webhooks import (
    WebhookClientConfig,
    injection_configuration,
    webhook_configuration,
)
from tests import programs
from tests.cluster.api import Api, ApiError, Object
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import config, start_manager, template
from tests.cluster.processes import Process, Processes
from tests.cluster.waiting import wait_until
from tests.patience import PATIENCE
from tests.ports import free_port


class Webhook:
    """A manager with its certificate; the API server does not call it yet.

    Attributes:
        port: the manager's webhook port.
        folder: contains ca.crt, tls.crt and tls.key.
        manager: the process.
    """

    def __init__(
        self,
        processes: Processes,
        api: Api,
        folder: Path,
        patience: int = 30,
        options: Sequence[str] = (),
        kubeconfig: Path | None = None,
    ) -> None:
        """Start.

        Args:
            processes: start the manager.
            api: for the namespace.
            folder: for the certificates.
            patience: seconds that the API server waits for a review; the default suits a slow machine.
            options: more options of the manager; with --detector-image the API server also calls it for pods.
            kubeconfig: the manager's account; by default the administrator's.
        """
        self._patience = patience
        self._sidecars = "--detector-image" in options
        self.port = free_port()
        self.folder = folder
        self.name = f"wayside-{secrets.token_hex(3)}"
        self._api = api
        self.configuration = self.certified()
        self.options = (*options, "--admission-port", str(self.port), "--admission-certificates", str(folder))
        self.manager: Process = start_manager(processes, api.namespace, *self.options, kubeconfig=kubeconfig)

    def certified(self) -> Object:
        """Make new certificates, and return the configuration that trusts them."""
        place = WebhookClientConfig.of_url(f"https://127.0.0.1:{self.port}")
        authority = make_certificates(self.folder, place.hosts)
        self.injection = injection_configuration(place, authority, [self._api.namespace], self.name)
        made = webhook_configuration(place, authority, [self._api.namespace], self.name)
        for each in (made, self.injection):
            each["webhooks"][0]["timeoutSeconds"] = self._patience
        return made

    @contextmanager
    def requested(self) -> Iterator[None]:
        """Have the API server call the manager during the block."""
        applied = [self.configuration, *([self.injection] if self._sidecars else [])]
        for each in applied:
            self._api.apply(each)
        try:
            self.wait_answering()
            yield
        finally:
            for each in applied:
                self._api.delete(each["kind"], self.name)

    def wait_answering(self) -> None:
        """Wait until an invalid object is rejected."""
        wait_until(self._refuses, bool, what="the API server calls the webhook, and the manager rejects")

    def wait_unasked(self) -> None:
        """Wait until an invalid object is stored."""
        wait_until(self._refuses, lambda refused: not refused, what="the API server no longer calls the webhook")

    def _refuses(self) -> bool:
        probe = template(f"probe-{secrets.token_hex(3)}", manifests=[config({}, name="the-same-for-all")])
        try:
            self._api.create(probe)
        except ApiError as error:
            if error.code != 422:
                raise
            return True
        self._api.delete("ApplicationTemplate", probe["metadata"]["name"])
        return False


def printed(*arguments: str) -> Object:
    """The object that `application-manager` prints."""
    done: Any = yaml.safe_load(programs.run("application-manager", *arguments, check=True).stdout)
    assert isinstance(done, dict)
    return done


def kubectl_apply(control_plane: ControlPlane, manifest: Object, namespace: str, *options: str) -> tuple[int, str]:
    """`kubectl apply` of a manifest: the exit code, and what was written to stderr."""
    command = [str(control_plane.binaries.kubectl), f"--kubeconfig={control_plane.kubeconfig}", "apply"]
    done = subprocess.run(
        [*command, "--namespace", namespace, "-f", "-", *options],
        input=json.dumps(manifest),
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env=os.environ | {"KUBECACHEDIR": str(control_plane.folder / "kubectl")},
        check=False,
    )
    return done.returncode, done.stderr
