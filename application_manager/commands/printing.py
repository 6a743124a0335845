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
    with importing():
        from application_manager.commands.webhooks import print_webhooks

    print_webhooks(service, url, ca_bundle, make_certificates, namespace or (), name, detectors=detectors)


def rbac(
    allowed_kinds: Annotated[
        list[str] | None,
        typer.Option(help="As of `run`: a kind that templates may create; repeatable. Replaces the default."),
    ] = None,
    namespace: Annotated[
        list[str] | None,
        typer.Option(
            help="As of `run`: a namespace to look after, which gets a Role; repeatable. Default: a ClusterRole that "
            "reads in all of them."
        ),
    ] = None,
    grant: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAMESPACE",
            help="Without --namespace: a namespace in which the manager may write, by a RoleBinding; repeatable.",
        ),
    ] = None,
    account: Annotated[
        str, typer.Option(metavar="NAMESPACE/NAME", help="The service account that the manager runs with.")
    ] = "wayside/application-manager",
    lease: Annotated[
        str | None, typer.Option(metavar="[NAMESPACE/]NAME", help="As of `run`. Default: in the account's namespace.")
    ] = None,
    detectors: Annotated[
        bool, typer.Option("--detectors", help="For a manager with --detector-image, which runs detectors too.")
    ] = False,
    name: Annotated[
        str, typer.Option(help="Of the roles and bindings; managers of different namespaces need different ones.")
    ] = "wayside-application-manager",
    admission_service: Annotated[
        str | None,
        typer.Option(metavar="NAMESPACE/NAME", help="As of `run`: a manager that makes its certificate."),
    ] = None,
    admission_webhooks: Annotated[str, typer.Option(metavar="NAME", help="As of `run`.")] = "wayside",
) -> None:
    """Print the roles that the manager's account needs for the kinds that templates may create, and no more.

    Only a kind that is not one of the default ones is looked up in the cluster of the current kubeconfig.
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
    namespace: Annotated[str, typer.Option("--namespace", "-n", help="Its namespace.")],
    pod_account: Annotated[
        list[str] | None,
        typer.Option(help="An account of pods that have the detector as a sidecar; repeatable. No other is made."),
    ] = None,
) -> None:
    """Print the account of a detector that you run yourself, with the rights that it needs, and no more."""
    with importing():
        from application_manager.commands.rbac import print_detector_rbac

    print_detector_rbac(name, namespace, pod_account or ())


def inject(
    files: Annotated[
        list[str],
        typer.Option("--file", "-f", metavar="FILE|-", help="A YAML file, or - for stdin; repeatable. Detectors too."),
    ],
    namespace: Annotated[
        str, typer.Option("--namespace", "-n", help="Of manifests that name none, for Detectors of the cluster.")
    ] = "default",
    detector_image: Annotated[
        str | None, typer.Option(help="As of `run`: the image of detectors that name none.")
    ] = None,
) -> None:
    """Print the manifests with the detectors in them that their pods ask for by the label wayside.dev/detector.

    Pods, and what makes pods, e.g. a Deployment. The Detectors come from the files, else from the cluster of the
    current kubeconfig. What requests none, or has it already, is printed unchanged. If a pod cannot
    have its detector, an error gives the reason, the pod is printed unchanged, and the exit code is 1.
    """
    with importing():
        from application_manager.commands.injecting import print_injected

    print_injected(files, namespace, detector_image)
