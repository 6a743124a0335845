"""The commands that print manifests to be applied: `webhooks`, `rbac`, `detector-rbac` and `inject`.

Declared here; what a command runs is imported when it runs, so that `--help` need not.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from wayside.process.beginning import importing


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
        from application_manager.commands.webhooks import print_webhooks

    print_webhooks(service, url, ca_bundle, make_certificates, namespace or (), name, detectors=detectors)


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
        from application_manager.commands.rbac import print_rbac

    print_rbac(
        allowed_kinds,
        namespace or (),
        account,
        lease,
        name,
        detectors=detectors,
        grant=grant or (),
        service=admission_service,
        webhooks=admission_webhooks,
    )


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
        from application_manager.commands.rbac import print_detector_rbac

    print_detector_rbac(name, namespace, pod_account or ())


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
