"""The command line: `application-manager run`, `render` and `explain`.

That the API server refuses us at the start is bad input as well: the account and its rights are given to us.
"""

from __future__ import annotations

import asyncio
import json
import logging
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from application_manager.chartcache import default_folder
from application_manager.connection import ConfigurationError
from application_manager.core.policy import Policy
from application_manager.helm import Helm
from application_manager.inquiry import InquiryError, inquire
from application_manager.offline import render_files
from application_manager.publishing import settings
from application_manager.service import Options, serve
from application_manager.telling import text
from wayside import commandline
from wayside.api.base import Duration
from wayside.api.documents import DocumentError

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Makes a cluster run what the live ApplicationTasks demand.",
)

EXPECTED = (DocumentError, ConfigurationError, InquiryError)
"""Errors of the input: said in one line, without a trace."""

RESYNC = Duration("60s")
TTL_AFTER_FINISHED = Duration("1h")

AllowedKinds = Annotated[
    list[str] | None,
    typer.Option(help="A kind that templates may create, e.g. apps/v1/Deployment; repeatable. Replaces the default."),
]
HelmProgram = Annotated[
    str, typer.Option(help="The helm program, a path or a name on PATH, for templates with charts.")
]
ChartCacheFolder = Annotated[
    Path | None, typer.Option(help="The folder to keep fetched charts in. Default: ~/.cache/wayside/charts.")
]
CHART_FOLDER = Path("/charts")
ChartFolder = Annotated[Path, typer.Option(help="The folder with charts that templates may name by their path.")]
ServiceAccounts = Annotated[
    list[str] | None,
    typer.Option(help="A service account that templates may use; repeatable. Default: only `default`, without token."),
]


@app.callback()
def _main(
    debug: Annotated[bool, typer.Option(commandline.DEBUG, help="Show the trace of an error, and log more.")] = False,
) -> None:
    logging.basicConfig(
        level=logging.DEBUG if debug else logging.INFO,
        format="%(asctime)s %(levelname)-7s %(message)s",
        stream=sys.stderr,
    )
    for noisy in ("asyncio", "aiohttp", "kopf"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    if not debug:  # each watch tells of each attempt to come back; that the API server is away is said once, by us
        for handler in logging.getLogger().handlers:
            handler.addFilter(lambda record: not record.getMessage().startswith("Request attempt"))


def _duration(text: str) -> Duration:
    try:
        return Duration.parse(text)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None


def _policy(kinds: list[str] | None, accounts: list[str] | None) -> Policy:
    try:
        return Policy.parse(kinds, accounts)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--allowed-kinds") from None


@app.command()
def run(
    namespace: Annotated[
        list[str] | None, typer.Option(help="A namespace to look after; repeatable. Default: all.")
    ] = None,
    resync: Annotated[
        Duration, typer.Option(parser=_duration, metavar="DURATION", help="How often everything is listed anew.")
    ] = RESYNC,
    ttl_after_finished: Annotated[
        Duration, typer.Option(parser=_duration, metavar="DURATION", help="How long finished tasks are kept.")
    ] = TTL_AFTER_FINISHED,
    metrics_port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Serve /metrics, /healthz and /readyz here. Default: nowhere.")
    ] = None,
    zenoh: Annotated[
        list[str] | None,
        typer.Option(
            help="Publish the instances' configurations on Zenoh, as a client of this endpoint, e.g. tcp/zenoh:7447 "
            "(repeatable), or as a Zenoh configuration file says (its name ends with .json5)."
        ),
    ] = None,
    helm: HelmProgram = "helm",
    chart_cache: ChartCacheFolder = None,
    chart_folder: ChartFolder = CHART_FOLDER,
    allowed_kinds: AllowedKinds = None,
    service_accounts: ServiceAccounts = None,
) -> None:
    """Run the operator, in the cluster of the current kubeconfig or of the pod."""
    options = Options(
        policy=_policy(allowed_kinds, service_accounts),
        namespaces=tuple(namespace or ()),
        resync=resync.seconds,
        ttl_after_finished=ttl_after_finished.seconds,
        metrics_port=metrics_port,
        zenoh=settings(zenoh) if zenoh else None,
        helm=Helm(helm),
        chart_cache=chart_cache or default_folder(),
        chart_folder=chart_folder,
    )
    asyncio.run(serve(options))
    commandline.leave()


@app.command()
def render(
    templates: Annotated[list[Path], typer.Option(help="A file or folder of ApplicationTemplates; repeatable.")],
    tasks: Annotated[list[Path], typer.Option(help="A file or folder of ApplicationTasks; repeatable.")],
    allowed_kinds: AllowedKinds = None,
    service_accounts: ServiceAccounts = None,
) -> None:
    """Print what would run, as YAML: merged instances and their manifests, without a cluster.

    What waits, is held at a bound or is refused is said on stderr; where something is refused, the exit code is 1.
    """
    policy = _policy(allowed_kinds, service_accounts)
    result = render_files([*templates, *tasks], policy)
    sys.stdout.write(result.text)
    for line in (*result.notes, *result.refusals):
        typer.echo(line, err=True)
    if result.refusals:
        raise typer.Exit(1)


class Output(StrEnum):
    """How an explanation is printed."""

    TEXT = "text"
    JSON = "json"


@app.command()
def explain(
    subject: Annotated[str, typer.Argument(help="A task or an instance: its name, or task/NAME or instance/NAME.")],
    namespace: Annotated[str | None, typer.Option("--namespace", "-n", help="Default: the kubeconfig's.")] = None,
    output: Annotated[Output, typer.Option("--output", "-o", help="For people or for programs.")] = Output.TEXT,
) -> None:
    """Say why a task is served or not, and why an instance runs as it does: from the event to the pods."""
    explanation = asyncio.run(inquire(subject, namespace))
    if output is Output.JSON:
        sys.stdout.write(f"{json.dumps(explanation.to_json(), indent=2, ensure_ascii=False)}\n")
    else:
        sys.stdout.write(text(explanation))


def main() -> None:
    """The console script."""
    sys.exit(commandline.run(app, "application-manager", EXPECTED, sys.argv[1:]))


if __name__ == "__main__":
    main()
