"""The command `detector catalog`. It imports its implementation when it runs, so that `--help` stays fast."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from wayside.process.commandline import refuse
from wayside.process.startup import importing

if TYPE_CHECKING:
    from detector.commands.catalog.catalog import Catalog, Read

_WIDTH = 160
"""Width in columns of a table that goes into a pipe or a file."""

_OTHERWISE = "give either files or folders with EventRules, or --cluster"


class Format(StrEnum):
    """The output format of the catalog."""

    TABLE = "table"
    MARKDOWN = "markdown"
    JSON = "json"
    HTML = "html"


def command(
    files: Annotated[list[Path] | None, typer.Argument(help="YAML files or folders with EventRules.")] = None,
    cluster: Annotated[
        bool, typer.Option("--cluster", help="Read the EventRules from the API server instead of files.")
    ] = False,
    namespace: Annotated[
        str | None, typer.Option(help="With --cluster: the namespace. Default: the kubeconfig's, or the pod's.")
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="DIMENSION=VALUE",
            help=(
                "Only rules with this value, e.g. typeOfAction=Deployment. Repeatable: values of the same "
                "dimension are alternatives, all dimensions must match."
            ),
        ),
    ] = None,
    form: Annotated[Format, typer.Option("--format", help="The output format.")] = Format.TABLE,
    output: Annotated[Path | None, typer.Option(help="Write into this file. Default: print.")] = None,
) -> None:
    """List rules by the dimensions and values of the classification scheme."""
    if bool(files) == cluster:
        refuse("give files or folders with EventRules, or --cluster")
    if namespace is not None and not cluster:
        refuse("--namespace requires --cluster; rules in files name their namespace themselves")
    with importing():
        import asyncio

        from detector.commands.catalog.catalog import ChoiceError, catalog, choose, read_files

    try:
        chosen = choose(only or ())
    except ChoiceError as error:
        refuse(f"--only {error}")
    read = asyncio.run(_read_cluster(namespace)) if cluster else read_files(files or ())
    for text in read.unreadable:
        typer.echo(f"left out, because it cannot be read: {text}", err=True)
    found = catalog(read.entries, chosen)
    text = _text(found, form, into_file=output is not None)
    if output is None:
        typer.echo(text, nl=False)
    else:
        output.write_text(text, encoding="utf-8")
    typer.echo(f"{len(found.entries)} of {len(read.entries)} rules" + (f": {output}" if output else ""), err=True)


async def _read_cluster(namespace: str | None) -> Read:
    """The EventRules of the namespace. Unreadable ones, e.g. of a newer version, are reported and left out.

    Args:
        namespace: default: the kubeconfig context's, or the pod's own.

    Raises:
        ConfigurationError: there is neither a kubeconfig nor a pod's account, or the API server forbids the list.
    """
    from detector.commands.catalog.catalog import CatalogEntry, Read, entry
    from detector.resources.kubernetes import EVENT_RULES, PROGRAM
    from wayside.api import API_VERSION, EventRule
    from wayside.api.documents import parse_object
    from wayside.kubernetes.connection import ConfigurationError, connect
    from wayside.kubernetes.errors import RequestError

    entries: list[CatalogEntry] = []
    unreadable: list[str] = []
    async with connect(PROGRAM, namespace, otherwise=_OTHERWISE) as cluster:
        try:
            listed, _ = await cluster.client.list(EVENT_RULES, cluster.namespace)
        except RequestError as error:
            raise ConfigurationError(
                f"cannot list the EventRules of namespace {cluster.namespace}: {error}. Check that "
                "KUBECONFIG points to the right cluster, and that its account may list "
                "eventrules.wayside.dev there"
            ) from error
        for each in listed:
            # The manager owns the status, and a newer manager's may have unknown fields.
            read = {name: value for name, value in each.items() if name != "status"}
            try:
                rule = parse_object({"apiVersion": API_VERSION, "kind": EventRule.__name__} | read)
            except ValueError as error:
                unreadable.append(f"EventRule {each['metadata']['name']}: {error}")
                continue
            assert isinstance(rule, EventRule)  # noqa: S101  the resource defines it
            entries.append(entry(rule, f"namespace {rule.namespace}"))
    return Read(tuple(entries), tuple(unreadable))


def _text(found: Catalog, form: Format, *, into_file: bool) -> str:
    """The catalog in this format; the width of a table depends on the destination."""
    from detector.commands.catalog import views
    from detector.commands.catalog.views import page

    match form:
        case Format.MARKDOWN:
            return views.markdown_view(found)
        case Format.JSON:
            return views.json_view(found)
        case Format.HTML:
            return page(found)
        case Format.TABLE:
            return _table(found, into_file=into_file)


def _table(found: Catalog, *, into_file: bool) -> str:
    from rich.console import Console

    from detector.commands.catalog.views import terminal_view

    console = Console()
    if into_file or not console.is_terminal:
        console = Console(width=_WIDTH, no_color=True)
    with console.capture() as captured:
        console.print(terminal_view(found), highlight=False, markup=False)
    return captured.get()
