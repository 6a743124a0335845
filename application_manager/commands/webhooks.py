"""`application-manager webhooks`: the webhook configurations that make the API server call the manager, as YAML."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import typer

from application_manager.core.findings.webhooks import (
    WebhookClientConfig,
    injection_configuration,
    webhook_configuration,
)
from wayside.kubernetes.connection import ConfigurationError
from wayside.manifests import to_yaml
from wayside.process import commandline


def print_webhooks(
    service: str | None,
    url: str | None,
    ca_bundle: Path | None,
    folder: Path | None,
    namespaces: Sequence[str],
    name: str,
    *,
    detectors: bool,
) -> None:
    """Print the configurations as YAML.

    Args:
        service: the manager's Service as NAMESPACE/NAME[:PORT]; or else `url`.
        url: of a manager elsewhere.
        ca_bundle: the certificate of the authority, a PEM file.
        folder: where an authority and a certificate are made in place of `ca_bundle`.
        namespaces: those that are managed; empty: all.
        name: of the objects.
        detectors: whether detectors are put into pods.

    Raises:
        ConfigurationError: the certificate cannot be read.
    """
    if (service is None) == (url is None):
        commandline.refuse("give either --service NAMESPACE/NAME or --url https://HOST:PORT")
    if ca_bundle is not None and folder is not None:
        commandline.refuse("give either --ca-bundle or --make-certificates")
    try:
        place = (
            WebhookClientConfig.of_service(service) if service is not None else WebhookClientConfig.of_url(url or "")
        )
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--url" if service is None else "--service") from None
    bundle = _authority(ca_bundle, folder, place)
    made = [webhook_configuration, *([injection_configuration] if detectors else [])]
    sys.stdout.write(to_yaml([each(place, bundle, namespaces, name) for each in made]))


def _authority(given: Path | None, folder: Path | None, place: WebhookClientConfig) -> bytes | None:
    if folder is not None:
        from application_manager.admission.issuing import make_certificates  # noqa: PLC0415  hardly ever needed

        return make_certificates(folder, place.hosts)
    if given is None:
        return None
    try:
        content = given.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"--ca-bundle {given}: {error.strerror or error}: give a readable file") from error
    if b"-----BEGIN CERTIFICATE-----" not in content:
        raise ConfigurationError(f"--ca-bundle {given}: contains no certificate: give the CA's PEM file")
    return content
