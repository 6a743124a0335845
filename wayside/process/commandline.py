"""The common behaviour of all commands: an error is one clear line, and `--debug` prints the traceback.

Wrong usage and wrong input end with exit code 2. `--debug` can be before or after the command.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn, cast

import typer

if TYPE_CHECKING:
    from rich.console import Console


class LogFormat(StrEnum):
    """How log lines are written."""

    TEXT = "text"
    JSON = "json"


LogFormatOption = Annotated[
    LogFormat, typer.Option(envvar="WAYSIDE_LOG_FORMAT", help="The format of log lines; json: one object per line.")
]
MetricsCertificates = Annotated[
    Path | None,
    typer.Option(
        help="With --metrics-port: serve with TLS, with tls.crt and tls.key from this folder; renewed files are loaded."
    ),
]
CheckedFiles = Annotated[list[Path] | None, typer.Argument(help="YAML files or folders.")]
IgnoredFindings = Annotated[
    list[str] | None, typer.Option(metavar="NAME", help="Do not report warnings of this name; may be repeated.")
]
StrictCheck = Annotated[bool, typer.Option("--strict", help="Exit with 1 if there are warnings.")]
ListFindings = Annotated[bool, typer.Option("--list", help="Print the names of all findings, and exit.")]

_WIDTH = 160
"""The width of a table in a pipe or a file, in columns."""

BAD_INPUT = 2
INTERRUPTED = 130
DEBUG = "--debug"
Debug = Annotated[bool, typer.Option(DEBUG, help="Show the stack trace of an error, and log more.")]

_UsageError = cast("type[typer.BadParameter]", typer.BadParameter.__mro__[1])
"""The base class of all usage errors, which typer does not export."""


def run_cli(app: typer.Typer, program: str, expected: tuple[type[Exception], ...], arguments: Sequence[str]) -> int:
    """Run the command line and report errors. Returns the exit code.

    Args:
        app: the commands; its callback takes `--debug`.
        program: the name of the program.
        expected: the errors of the input, which are printed without a traceback; other errors keep theirs.
        arguments: the arguments without the program's name.
    """
    debug = DEBUG in arguments
    arguments = [*([DEBUG] if debug else []), *(each for each in arguments if each != DEBUG)]
    try:
        return app(arguments, prog_name=program, standalone_mode=False) or 0
    except typer.Abort:
        return INTERRUPTED
    except Exception as error:  # the edge of the program: an unexpected error is raised again
        causes = _leaves(error)
        if not all(isinstance(each, (_UsageError, *(() if debug else expected))) for each in causes):
            raise
        for each in causes:
            _report(program, each)
        return BAD_INPUT


def log_to_stderr(form: str, *, debug: bool) -> None:
    """Write log lines in this form to stderr; with `debug`, more of them."""
    logging.basicConfig(level=logging.DEBUG if debug else logging.INFO, format=form, stream=sys.stderr)


def table_console(*, stderr: bool = False) -> Console:
    """The console for tables: as wide as the terminal, or with a fixed width for a pipe or a file."""
    from rich.console import Console  # noqa: PLC0415  not for `--help` alone

    found = Console(stderr=stderr)
    return found if found.is_terminal else Console(stderr=stderr, width=_WIDTH)


def log_as(log_format: LogFormat) -> None:
    """Write log lines in this format from now on.

    JSON: one object per line with `time`, `level`, `logger` and `message`.

    The object also contains an exception, as `exc_info`, so that a log collector receives it as one record.
    """
    if log_format is LogFormat.TEXT:
        return
    from pythonjsonlogger.json import JsonFormatter  # noqa: PLC0415  only long-running programs use it

    names = {"levelname": "level", "name": "logger"}
    for handler in logging.getLogger().handlers:
        handler.setFormatter(JsonFormatter(["levelname", "name", "message"], rename_fields=names, timestamp="time"))


def leave() -> NoReturn:
    """End the process with exit code 0, after everything is closed and written.

    A thread in native code (of Zenoh, or of an abandoned action) may just return into Python at this time. The
    interpreter's normal exit would unwind that thread, and the native code would abort: "exception not rethrown".
    """
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def refuse(message: str) -> NoReturn:
    """Refuse the command line for a reason that the parser does not check."""
    raise typer.BadParameter(message)


def _report(program: str, error: BaseException) -> None:
    if not isinstance(error, _UsageError):
        print(f"{program}: {error}", file=sys.stderr)  # noqa: T201  the one place
    elif message := error.format_message():  # otherwise the help is already printed
        command = error.ctx.command_path if error.ctx is not None else program
        print(f"{program}: {' '.join(message.split()).rstrip('.')}; see {command} --help", file=sys.stderr)  # noqa: T201


def _leaves(error: BaseException) -> list[BaseException]:
    """The errors in a group, at any level."""
    if not isinstance(error, BaseExceptionGroup):
        return [error]
    return [leaf for each in error.exceptions for leaf in _leaves(each)]
