"""The output of `detector check`: a line for each finding, with its name at the end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import typer

from detector.assembly.checking import checked_summary, findings
from detector.findings.checks import CHECKS, UNREADABLE_RECORDING
from wayside.api.documents import DocumentError, load_documents
from wayside.findings import UNREADABLE_FILE, check_lines, ignorable


def list_checks() -> None:
    """Print the name, severity and meaning of every finding."""
    for line in check_lines(CHECKS):
        typer.echo(line)


def check_files(files: Sequence[Path], recordings: Sequence[Path], ignore: Sequence[str], *, strict: bool) -> None:
    """Print the problems of the files, and exit with 1 if there is an error, or with `strict` a warning.

    Args:
        files: Detectors and EventRules.
        recordings: also replayed, if the files have no errors.
        ignore: the names of warnings that are not printed.
        strict: whether a warning fails the check.

    Raises InputError if a name in `ignore` is not the name of a warning.
    """
    ignored = ignorable(ignore, CHECKS)
    try:
        documents = load_documents(files)
    except DocumentError as error:
        for problem in error.problems:
            typer.echo(f"{problem} [{UNREADABLE_FILE.name}]", err=True)
        raise typer.Exit(1) from None
    found = findings(documents)
    warnings = [f"{each.as_warning()} [{each.check}]" for each in found.warnings if each.check not in ignored]
    for problem in found.problems:
        typer.echo(f"{problem} [{problem.check}]", err=True)
    for line in warnings:
        typer.echo(line, err=True)
    unread: Sequence[Exception] = ()
    if recordings and not found.problems:
        from detector.commands.replay import doubts_of  # noqa: PLC0415  a replay loads much more than a check

        doubts, unread = doubts_of(documents, recordings)
        shown = [f"{each.as_warning()} [{each.check}]" for each in doubts if each.check not in ignored]
        for line in shown:
            typer.echo(line, err=True)
        warnings += shown
    for damaged in unread:
        typer.echo(f"error: {damaged} [{UNREADABLE_RECORDING.name}]", err=True)
    if found.problems or unread or (strict and warnings):
        raise typer.Exit(1)
    count = f", {len(warnings)} warning{'s' if len(warnings) > 1 else ''}" if warnings else ""
    typer.echo(f"{checked_summary(documents)}: no errors{count}", err=True)
