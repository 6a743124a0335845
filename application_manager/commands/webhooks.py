"""`application-manager webhooks`: what makes the API server ask the manager, as YAML to be applied."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from application_manager.cluster.connection import ConfigurationError
from application_manager.core.findings.webhooks import Place, injection_configuration, webhook_configuration
from wayside import commandline
from wayside.manifests import to_yaml


def webhooks(
    service: Annotated[
        str | None,
        typer.Option(metavar="NAMESPACE/NAME[:PORT]", help="The manager's Service. The port's default: 443."),
    ] = None,
    url: Annotated[
        str | None,
        typer.Option(metavar="https://HOST:PORT", help="In place of --service: a manager that is elsewhere."),
    ] = None,
    ca_bundle: Annotated[
        Path | None,
        typer.Option(
            help="The certificate (PEM) of the authority that signed the manager's. Without it somebody else "
            "must write it in, as cert-manager does."
        ),
    ] = None,
    make_certificates: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="In place of --ca-bundle, for trials: make an authority and a certificate "
            "that is valid for a year, as ca.crt, tls.crt and tls.key in this folder.",
        ),
    ] = None,
    namespace: Annotated[
        list[str] | None, typer.Option(help="As of `run`: the namespaces that the manager looks after; repeatable.")
    ] = None,
    detectors: Annotated[
        bool,
        typer.Option(
            "--detectors", help="For a manager with --detector-image: also what puts detectors into pods (Sidecar)."
        ),
    ] = False,
    name: Annotated[str, typer.Option(help="Of the objects; managers of different namespaces need different ones.")] = (
        "wayside"
    ),
) -> None:
    """Print what makes the API server ask a manager with --admission-port about templates, rules and detectors."""
    if (service is None) == (url is None):
        commandline.refuse("give either --service NAMESPACE/NAME or --url https://HOST:PORT")
    if ca_bundle is not None and make_certificates is not None:
        commandline.refuse("--ca-bundle and --make-certificates exclude each other: give one")
    try:
        place = Place.of_service(service) if service is not None else Place.of_url(url or "")
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--url" if service is None else "--service") from None
    bundle = _authority(ca_bundle, make_certificates, place)
    made = [webhook_configuration, *([injection_configuration] if detectors else [])]
    sys.stdout.write(to_yaml([each(place, bundle, namespace or (), name) for each in made]))


def _authority(given: Path | None, folder: Path | None, place: Place) -> bytes | None:
    if folder is not None:
        from application_manager.admission.authority import make_certificates  # noqa: PLC0415  hardly ever asked for

        return make_certificates(folder, place.hosts)
    if given is None:
        return None
    try:
        content = given.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"--ca-bundle {given}: {error.strerror or error}: give a readable file") from error
    if b"-----BEGIN CERTIFICATE-----" not in content:
        raise ConfigurationError(f"--ca-bundle {given}: holds no certificate: give a PEM file of the authority")
    return content
