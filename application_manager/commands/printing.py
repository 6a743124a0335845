"""The commands that print manifests to apply: `webhooks`, `rbac`, `detector-rbac` and `inject`.

They are declared here; a command imports its implementation when it runs, so that `--help` stays fast.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from application_manager.commands.options import checking, lease_of, policy_of
from wayside.process import commandline
from wayside.process.startup import importing


def webhooks(
    service: Annotated[
        str | None,
        typer.Option(metavar="NAMESPACE/NAME[:PORT]", help="The manager's Service. The port's default: 443."),
    ] = None,
    url: Annotated[
        str | None,
        typer.Option(
            metavar="https://HOST:PORT", help="In place of --service: the URL of a manager outside the cluster."
        ),
    ] = None,
    ca_bundle: Annotated[
        Path | None,
        typer.Option(
            help="The certificate (PEM) of the CA that signed the manager's certificate. Default: another "
            "program, such as cert-manager, adds the certificate."
        ),
    ] = None,
    make_certificates: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="In place of --ca-bundle, for trials: create a CA and a certificate, valid for a year, as ca.crt, "
            "tls.crt and tls.key in this folder.",
        ),
    ] = None,
    namespace: Annotated[
        list[str] | None, typer.Option(help="As for `run`: a namespace to manage; repeatable.")
    ] = None,
    detectors: Annotated[
        bool,
        typer.Option(
            "--detectors",
            help="For a manager with --detector-image: also the webhook that injects detectors into pods (Sidecar).",
        ),
    ] = False,
    name: Annotated[
        str, typer.Option(help="The name of the objects; managers of different namespaces need different ones.")
    ] = ("wayside"),
) -> None:
    """Print the webhook configurations for a manager with --admission-port."""
    with importing():
        from application_manager.core.findings.webhooks import (
            WebhookClientConfig,
            injection_configuration,
            webhook_configuration,
        )
        from wayside.manifests import to_yaml

    if (service is None) == (url is None):
        commandline.refuse("give either --service NAMESPACE/NAME or --url https://HOST:PORT")
    if ca_bundle is not None and make_certificates is not None:
        commandline.refuse("give either --ca-bundle or --make-certificates")
    with checking("--url" if service is None else "--service"):
        place = (
            WebhookClientConfig.of_service(service) if service is not None else WebhookClientConfig.of_url(url or "")
        )
    bundle = _authority(ca_bundle, make_certificates, place.hosts)
    made = [webhook_configuration, *([injection_configuration] if detectors else [])]
    sys.stdout.write(to_yaml([each(place, bundle, namespace or (), name) for each in made]))


def _authority(given: Path | None, folder: Path | None, hosts: Sequence[str]) -> bytes | None:
    """The certificate of the CA, from the file or created in the folder. Raises ConfigurationError."""
    if folder is not None:
        from application_manager.admission.issuer import make_certificates

        return make_certificates(folder, hosts)
    if given is None:
        return None
    from wayside.kubernetes.connection import ConfigurationError

    try:
        content = given.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"--ca-bundle {given}: {error.strerror or error}: give a readable file") from error
    if b"-----BEGIN CERTIFICATE-----" not in content:
        raise ConfigurationError(f"--ca-bundle {given}: contains no certificate: give the CA's PEM file")
    return content


def rbac(
    allowed_kinds: Annotated[
        list[str] | None,
        typer.Option(help="As for `run`: a kind that templates may create; repeatable. Replaces the default."),
    ] = None,
    namespace: Annotated[
        list[str] | None,
        typer.Option(
            help="As for `run`: a namespace to manage, which gets a Role; repeatable. Default: a ClusterRole that "
            "reads in all namespaces."
        ),
    ] = None,
    grant: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAMESPACE",
            help="Without --namespace: a namespace in which the manager may write, through a RoleBinding; repeatable.",
        ),
    ] = None,
    account: Annotated[
        str, typer.Option(metavar="NAMESPACE/NAME", help="The service account that the manager runs with.")
    ] = "wayside/application-manager",
    lease: Annotated[
        str | None,
        typer.Option(metavar="[NAMESPACE/]NAME", help="As for `run`. Default: in the service account's namespace."),
    ] = None,
    detectors: Annotated[bool, typer.Option("--detectors", help="For a manager with --detector-image.")] = False,
    name: Annotated[
        str,
        typer.Option(help="The name of the roles and bindings; managers of different namespaces need different ones."),
    ] = "wayside-application-manager",
    admission_service: Annotated[
        str | None,
        typer.Option(metavar="NAMESPACE/NAME", help="As for `run`: for a manager that creates its certificate."),
    ] = None,
    admission_webhooks: Annotated[str, typer.Option(metavar="NAME", help="As for `run`.")] = "wayside",
) -> None:
    """Print the minimal roles of the manager's service account for the kinds that templates may create.

    Kinds other than the default ones are looked up in the cluster of the current kubeconfig.
    """
    with importing():
        from application_manager.cluster.leadership import LEASE_NAME
        from application_manager.commands.plurals import plurals
        from application_manager.core.findings.webhooks import certificate_secret
        from application_manager.core.objects.rights import roles
        from wayside.manifests import to_yaml

    where, _, who = account.partition("/")
    if not where or not who:
        raise typer.BadParameter(f"must be NAMESPACE/NAME; got {account!r}", param_hint="--account")
    if grant and namespace:
        raise typer.BadParameter("has no effect with --namespace: remove one of them", param_hint="--grant")
    policy = policy_of(allowed_kinds, None, everywhere=not namespace)
    key = lease_of(lease if lease and "/" in lease else f"{where}/{lease or LEASE_NAME}", ())
    certificates = None
    if admission_service:
        with checking("--admission-service"):
            certificates = certificate_secret(admission_service), admission_webhooks
    made = roles(
        plurals(policy),
        namespace or (),
        (key.namespace, key.name),
        (where, who),
        name,
        detectors=detectors,
        granted=grant or (),
        certificates=certificates,
    )
    sys.stdout.write(to_yaml(made))


def detector_rbac(
    name: Annotated[str, typer.Argument(help="The Detector.")],
    namespace: Annotated[str, typer.Option("--namespace", "-n", help="The namespace of the Detector.")],
    pod_account: Annotated[
        list[str] | None,
        typer.Option(
            help="A service account of pods with the detector as a sidecar, instead of a new one; repeatable."
        ),
    ] = None,
) -> None:
    """Print the service account and the minimal roles of a detector that you run yourself."""
    with importing():
        from application_manager.core.objects.detectors import detector_roles, sidecar_roles
        from wayside.api.base import ObjectName, SubdomainName
        from wayside.manifests import to_yaml

    _check_name(name, ObjectName, "Detector name of at most 63 lower-case letters, digits and -", "NAME")
    for account in pod_account or ():
        _check_name(
            account, SubdomainName, "service account name of lower-case letters, digits, - and .", "--pod-account"
        )
    made = sidecar_roles(namespace, name, pod_account) if pod_account else detector_roles(namespace, name)
    sys.stdout.write(to_yaml(made))


def _check_name(name: str, type_: Any, what: str, option: str) -> None:
    from pydantic import TypeAdapter, ValidationError

    try:
        TypeAdapter(type_).validate_python(name)
    except ValidationError:
        raise typer.BadParameter(f"must be a {what}; got {name!r}", param_hint=option) from None


def inject(
    files: Annotated[
        list[str],
        typer.Option(
            "--file",
            "-f",
            metavar="FILE|-",
            help="A YAML file with manifests or Detectors, or - for stdin; repeatable.",
        ),
    ],
    namespace: Annotated[
        str,
        typer.Option("--namespace", "-n", help="The namespace of Detectors for manifests that set no namespace."),
    ] = "default",
    detector_image: Annotated[
        str | None, typer.Option(help="As for `run`: the image of detectors without one.")
    ] = None,
) -> None:
    """Print manifests after injecting the detectors that pods request with the label wayside.dev/detector.

    Injects into Pods and workloads, e.g. Deployments. Detectors come from the files, else from the cluster of the
    current kubeconfig. Other objects are printed unchanged. If a pod cannot have its detector, an error gives the
    reason, the pod is printed unchanged, and the exit code is 1.
    """
    with importing():
        from application_manager.commands.injecting import print_injected

    print_injected(files, namespace, detector_image)
