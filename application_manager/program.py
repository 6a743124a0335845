"""The console script: it can exit before the slow imports."""

from __future__ import annotations

from wayside.process.startup import end_on_sigterm, importing


def main() -> None:
    """Run the command line."""
    end_on_sigterm()
    with importing():
        from application_manager.commands.cli import main as run  # noqa: PLC0415  a slow import, after the handler

    run()
