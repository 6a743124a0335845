"""The command line: `application-manager run`, `render`, `check`, `explain`, `inject`, and those that print manifests.

Commands are declared here; a command imports its implementation when it runs, so that `--help` stays fast. A refusal by
the API server at the start counts as bad input as well, because the user gives the account and its rights.
"""

from __future__ import annotations

import json
import logging
import sys
import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from application_manager.commands.options import (
    PullPolicy,
    detectors_of,
    lease_of,
    option_bytes,
    policy_of,
    seconds_of,
    tasks_of,
    webhook_of,
)
from application_manager.commands.printing import detector_rbac, inject, rbac, webhooks
from wayside.inputerror import InputError
from wayside.process import commandline
from wayside.process.startup import importing

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Runs the applications that live ApplicationTasks demand.",
)

EXPECTED = (InputError,)
"""Errors of the input: one line each, without a trace."""

AllowedKinds = Annotated[
    list[str] | None,
    typer.Option(help="A kind that templates may create, e.g. apps/v1/Deployment; repeatable. Replaces the default."),
]
HelmProgram = Annotated[
    str, typer.Option(help="The helm program, a path or a name on PATH, for templates with charts.")
]
ChartCacheFolder = Annotated[
    Path | None, typer.Option(help="The folder for fetched charts. Default: ~/.cache/wayside/charts.")
]
CHART_FOLDER = Path("/charts")
ChartFolder = Annotated[Path, typer.Option(help="The folder with charts that templates may refer to by path.")]
ServiceAccounts = Annotated[
    list[str] | None,
    typer.Option(help="A service account that templates may use; repeatable. Default: only `default`, without token."),
]


MaxInstances = Annotated[
    int | None,
    typer.Option(min=1, help="The maximum number of instances in a namespace, over all templates. Default: no limit."),
]


@app.callback()
def _main(debug: commandline.Debug = False) -> None:
    commandline.log_to_stderr("%(asctime)s %(levelname)-7s %(message)s", debug=debug)
    for noisy in ("asyncio", "aiohttp", "kopf"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    if not debug:  # kopf logs each attempt of each watch to reconnect; we log once that the API server does not respond
        for handler in logging.getLogger().handlers:
            handler.addFilter(lambda record: not record.getMessage().startswith("Request attempt"))


@app.command()
def run(
    namespace: Annotated[
        list[str] | None, typer.Option(help="A namespace to manage; repeatable. Default: all.")
    ] = None,
    max_instances: MaxInstances = None,
    max_tasks: Annotated[
        int | None,
        typer.Option(min=1, help="The maximum number of unfinished tasks in a namespace. Default: no limit."),
    ] = None,
    holder_policy: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAMESPACE/HOLDER:LIMITS",
            help="Limits for the tasks of holders, e.g. town/*:max-tasks=100,max-priority=10,operations=Deploy. "
            "Repeatable; the first one that matches a holder applies. Default: no limit.",
        ),
    ] = None,
    resync: Annotated[str, typer.Option(metavar="DURATION", help="The interval of full lists.")] = "60s",
    ttl_after_finished: Annotated[
        str, typer.Option(metavar="DURATION", help="How long finished tasks are kept.")
    ] = "1h",
    stalled_after: Annotated[
        str,
        typer.Option(metavar="DURATION", help="The watchdog ends this manager after this time without progress."),
    ] = "5m",
    watch_timeout: Annotated[
        str,
        typer.Option(
            metavar="DURATION",
            help="Restart a watch after this time without an event or bookmark, and end this manager after twice "
            "this time.",
        ),
    ] = "90s",
    metrics_port: Annotated[
        int | None,
        typer.Option(
            min=0, max=65535, help="Serve /metrics, /healthz and /readyz on this port. Default: do not serve."
        ),
    ] = None,
    metrics_certificates: commandline.MetricsCertificates = None,
    zenoh: Annotated[
        list[str] | None,
        typer.Option(
            help="Publish the instances' configurations on Zenoh, as a client of this endpoint, e.g. tcp/zenoh:7447 "
            "(repeatable), or by a Zenoh configuration file (its name ends with .json5)."
        ),
    ] = None,
    expression_cpu_time: Annotated[
        str,
        typer.Option(
            metavar="DURATION",
            help="The maximum CPU time to evaluate the expressions of a template or rule, in a worker process.",
        ),
    ] = "3s",
    memory_limit: Annotated[
        str | None,
        typer.Option(
            metavar="QUANTITY",
            help="The memory limit of this manager and its worker processes, e.g. 1Gi. Near the limit, no new tasks "
            "are accepted. Default: the container's limit.",
        ),
    ] = None,
    lease: Annotated[
        str | None,
        typer.Option(
            metavar="[NAMESPACE/]NAME",
            help="The Lease by which one of several managers of the same namespaces becomes active. Default: "
            "application-manager, in the pod's namespace, else in the first managed one.",
        ),
    ] = None,
    helm: HelmProgram = "helm",
    chart_cache: ChartCacheFolder = None,
    chart_folder: ChartFolder = CHART_FOLDER,
    allowed_kinds: AllowedKinds = None,
    service_accounts: ServiceAccounts = None,
    detector_image: Annotated[
        str | None,
        typer.Option(
            help="Run the Detectors of mode Standalone, and inject those of mode Sidecar into pods. Detectors "
            "without an image use this one. Default: run no detectors."
        ),
    ] = None,
    detector_pull_policy: Annotated[
        PullPolicy | None,
        typer.Option(help="The pull policy of detectors' images. Default: Kubernetes chooses by the tag."),
    ] = None,
    detector_pull_secret: Annotated[
        list[str] | None,
        typer.Option(help="A Secret, in each namespace with detectors, to pull their images with; repeatable."),
    ] = None,
    detector_env: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="An environment variable of all detectors; repeatable."),
    ] = None,
    detector_user: Annotated[
        str | None,
        typer.Option(
            metavar="UID|cluster",
            help="The user ID of detectors, or `cluster` to let the cluster choose (OpenShift). Default: 65532.",
        ),
    ] = None,
    detector_metrics_secret: Annotated[
        str | None,
        typer.Option(
            help="A Secret with tls.crt and tls.key, in each namespace with detectors, to serve metrics and health "
            "with TLS. Default: without TLS."
        ),
    ] = None,
    admission_port: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=65535,
            help="Serve the webhooks that `application-manager webhooks` prints on this port. Default: do not serve.",
        ),
    ] = None,
    admission_certificates: Annotated[
        Path | None,
        typer.Option(help="With --admission-port: a folder with tls.crt and tls.key; renewed files are loaded."),
    ] = None,
    admission_service: Annotated[
        str | None,
        typer.Option(
            metavar="NAMESPACE/NAME",
            help="Create and renew the certificate for this Service. The manager stores it in the existing Secret "
            "NAME-certificates of the Service's namespace and writes it to --admission-certificates.",
        ),
    ] = None,
    admission_webhooks: Annotated[
        str,
        typer.Option(metavar="NAME", help="With --admission-service: the webhook configurations that get the CA."),
    ] = "wayside",
    log_format: commandline.LogFormatOption = commandline.LogFormat.TEXT,
) -> None:
    """Run the operator, in the cluster of the current kubeconfig or of the pod."""
    commandline.log_as(log_format)
    with importing():
        import asyncio

        from application_manager.charts.chartcache import default_folder
        from application_manager.charts.helm import HelmRunner
        from application_manager.running.headroom import container_limit
        from application_manager.running.options import Options
        from application_manager.running.service import serve
        from application_manager.work.publishing import settings

    options = Options(
        policy=policy_of(allowed_kinds, service_accounts, everywhere=not namespace),
        namespaces=tuple(namespace or ()),
        max_instances=max_instances,
        tasks=tasks_of(max_tasks, holder_policy),
        resync=seconds_of("--resync", resync),
        ttl_after_finished=seconds_of("--ttl-after-finished", ttl_after_finished),
        stalled_after=seconds_of("--stalled-after", stalled_after),
        watch_timeout=seconds_of("--watch-timeout", watch_timeout),
        metrics_port=metrics_port,
        memory_limit=option_bytes("--memory-limit", memory_limit) if memory_limit else container_limit(),
        metrics_certificates=metrics_certificates,
        cpu_time=seconds_of("--expression-cpu-time", expression_cpu_time),
        zenoh=settings(zenoh) if zenoh else None,
        helm=HelmRunner(helm),
        chart_cache=chart_cache or default_folder(),
        chart_folder=chart_folder,
        admission=webhook_of(admission_port, admission_certificates, admission_service, admission_webhooks),
        lease=lease_of(lease, tuple(namespace or ())),
        detectors=detectors_of(
            detector_image,
            detector_pull_policy,
            detector_pull_secret,
            detector_env,
            detector_user,
            detector_metrics_secret,
        ),
    )
    asyncio.run(serve(options))
    commandline.leave()


@app.command()
def render(
    templates: Annotated[list[Path], typer.Option(help="A file or folder of ApplicationTemplates; repeatable.")],
    tasks: Annotated[list[Path], typer.Option(help="A file or folder of ApplicationTasks; repeatable.")],
    max_instances: MaxInstances = None,
    allowed_kinds: AllowedKinds = None,
    service_accounts: ServiceAccounts = None,
    helm: HelmProgram = "helm",
    chart_cache: ChartCacheFolder = None,
    chart_folder: ChartFolder = CHART_FOLDER,
) -> None:
    """Print what would run, as YAML: merged instances and their manifests, without a cluster.

    Templates with a chart need the program helm; charts that are not cached are fetched.

    Waiting, capped and refused tasks are printed on stderr. If a task is refused, the exit code is 1.
    """
    with importing():
        from application_manager.charts.helm import HelmRunner
        from application_manager.commands.offline import charts_at_once, render_objects
        from wayside.api.documents import load_documents
        from wayside.manifests import to_yaml

    policy = policy_of(allowed_kinds, service_accounts)
    objects = [document.object for document in load_documents([*templates, *tasks])]
    charts = charts_at_once(HelmRunner(helm), chart_cache, chart_folder)
    result = render_objects(objects, policy, time.time(), max_instances, charts)
    sys.stdout.write(to_yaml(result.objects))
    for line in (*result.notes, *result.refusals):
        typer.echo(line, err=True)
    if result.refusals:
        raise typer.Exit(1)


@app.command()
def check(
    files: commandline.CheckedFiles = None,
    allowed_kinds: AllowedKinds = None,
    service_accounts: ServiceAccounts = None,
    strict: commandline.StrictCheck = False,
    ignore: commandline.IgnoredFindings = None,
    listing: commandline.ListFindings = False,
) -> None:
    """Check templates, rules and detectors as the webhook would, without a cluster.

    Exits with 1 if the webhook would refuse an object, or with --strict warn of one.
    """
    with importing():
        from application_manager.commands.checking import review_files
        from application_manager.core.findings.checks import CHECKS
        from wayside.api.documents import DocumentError
        from wayside.findings import UNREADABLE_FILE, check_lines, ignorable

    if listing:
        typer.echo("\n".join(check_lines(CHECKS)))
        raise typer.Exit
    if not files:
        commandline.refuse("give YAML files or folders, or --list")
    ignored = ignorable(ignore or (), CHECKS)
    try:
        checked = review_files(files, policy_of(allowed_kinds, service_accounts), ignored)
    except DocumentError as error:
        for problem in error.problems:
            typer.echo(f"{problem} [{UNREADABLE_FILE.name}]", err=True)
        raise typer.Exit(1) from None
    for line in checked.problems:
        typer.echo(line, err=True)
    for line in checked.warnings:
        typer.echo(f"warning: {line}", err=True)
    if checked.problems or (strict and checked.warnings):
        raise typer.Exit(1)
    typer.echo(f"checked {checked.objects}: nothing would be refused", err=True)


class Output(StrEnum):
    """The output format of an explanation."""

    TEXT = "text"
    JSON = "json"


@app.command()
def explain(
    subject: Annotated[str, typer.Argument(help="A task or an instance: its name, or task/NAME or instance/NAME.")],
    namespace: Annotated[
        str | None, typer.Option("--namespace", "-n", help="The namespace. Default: the kubeconfig's.")
    ] = None,
    output: Annotated[Output, typer.Option("--output", "-o", help="For people or for programs.")] = Output.TEXT,
) -> None:
    """Explain the state of a task or instance, from the event to the pods."""
    with importing():
        import asyncio

        from application_manager.commands.explanationtext import explanation_text
        from application_manager.commands.inquiry import inquire

    explanation = asyncio.run(inquire(subject, namespace))
    if output is Output.JSON:
        sys.stdout.write(f"{json.dumps(explanation.to_json(), indent=2, ensure_ascii=False)}\n")
    else:
        sys.stdout.write(explanation_text(explanation))


app.command()(webhooks)
app.command()(rbac)
app.command()(inject)
app.command("detector-rbac")(detector_rbac)


def main() -> None:
    """The console script."""
    sys.exit(commandline.run_cli(app, "application-manager", EXPECTED, sys.argv[1:]))


if __name__ == "__main__":
    main()
