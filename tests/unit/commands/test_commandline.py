"""Both programs report errors in one line, and take `--debug` before or after the command."""

from __future__ import annotations

import pytest
import typer

import application_manager.commands.cli
import detector.commands.cli
from wayside.process import commandline

APPS = [
    pytest.param(
        application_manager.commands.cli.app, ["render", "--tasks", "x"], "--templates", id="application-manager"
    ),
    pytest.param(detector.commands.cli.app, ["replay", "x"], "--output", id="detector"),
]


@pytest.mark.parametrize(("app", "incomplete", "lacks"), APPS)
def test_a_usage_error_is_one_line_with_program_and_help(
    app: typer.Typer, incomplete: list[str], lacks: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments in (incomplete, [*incomplete, "--debug"], ["--debug", *incomplete]):
        assert commandline.run_cli(app, "program", (), arguments) == 2
        reported = capsys.readouterr().err
        assert reported.startswith("program: ")
        assert lacks in reported
        assert reported.endswith(f"see program {incomplete[0]} --help\n")
        assert reported.count("\n") == 1


def failing(error: Exception) -> typer.Typer:
    app = typer.Typer(pretty_exceptions_enable=False)

    @app.callback()
    def main(debug: bool = False) -> None: ...

    @app.command()
    def run() -> None:
        raise error

    return app


def reported(error: Exception, capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert commandline.run_cli(failing(error), "program", (ValueError,), ["run", *arguments]) == 2
    return capsys.readouterr().err


def test_an_expected_error_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert reported(ValueError("no cluster"), capsys) == "program: no cluster\n"


def test_errors_of_tasks_side_by_side_are_a_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    group = ExceptionGroup("tasks", [ValueError("a"), ExceptionGroup("more", [ValueError("b")])])
    assert reported(group, capsys) == "program: a\nprogram: b\n"


def test_tracebacks_are_shown_with_debug_and_for_defects(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="no cluster"):
        reported(ValueError("no cluster"), capsys, "--debug")
    with pytest.raises(KeyError):
        reported(KeyError("a defect"), capsys)
