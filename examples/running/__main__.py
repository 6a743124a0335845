"""`python -m examples.running`: runs use cases and prints expected and actual results."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from rich.console import Console
from rich.table import Table

from detector.assembly import DetectorError
from detector.replay.message import RecordingError
from detector.testing import RefusedError
from examples.running.cases import CaseResult, folder_of, run, scenario_of, use_cases
from examples.running.recording import write_recording
from wayside.api.documents import DocumentError
from wayside.manifests import to_yaml

_AS_IT_MUST_BE, _DIFFERS = "[green]as it must be[/]", "[red]differs[/]"
_WIDTH = 120
"""Columns of a table that goes into a pipe or a file."""


def main() -> int:
    """Run the command line's request; 1: a result differs from the expected one, 2: it cannot be run."""
    options = _options()
    unknown = [name for name in options.names if name not in use_cases()]
    if unknown:
        print(f"no such use case: {', '.join(unknown)}. There are: {', '.join(use_cases())}", file=sys.stderr)
        return 2
    names = options.names or use_cases()
    if options.record is not None:
        if len(names) != 1:
            print("--record: name the one use case whose scenario to write", file=sys.stderr)
            return 2
        count = write_recording(scenario_of(names[0]).messages(), options.record)
        print(f"{count} messages in {options.record}")
        return 0
    if options.pictures:
        for name in names:
            scenario = scenario_of(name)
            (folder_of(name) / scenario.picture_file).write_text(scenario.picture(), encoding="utf-8")
        return 0
    with tempfile.TemporaryDirectory() as scratch:
        return _run(names, options.output, Path(scratch))


def _run(names: list[str], kept: Path | None, scratch: Path) -> int:
    console = Console(highlight=False, width=None if sys.stdout.isatty() else _WIDTH)
    ran: list[CaseResult] = []
    with console.status("") as status:
        for name in names:
            status.update(f"{name} ({len(ran) + 1} of {len(names)})")
            output = (kept or scratch) / name
            try:
                ran.append(run(name, output))
            except (DocumentError, DetectorError, RefusedError, RecordingError, OSError) as error:
                print(f"{name}: {error}", file=sys.stderr)
                return 2
            _write(ran[-1], output)
    console.print(_table(ran))
    for each in ran:
        for problem in each.verdict.problems:
            console.print(f"[red]{each.name}:[/] {problem}", soft_wrap=True)
    return 0 if all(each.verdict.as_it_must_be for each in ran) else 1


def _write(ran: CaseResult, output: Path) -> None:
    lines = "".join(f"{event.to_json()}\n" for event in ran.played.events)
    (output / "events.jsonl").write_text(lines, encoding="utf-8")
    if ran.played.tasks:
        text = to_yaml([task.to_json() for task in ran.played.tasks])
        (output / "tasks.yaml").write_text(text, encoding="utf-8")


def _table(ran: list[CaseResult]) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("use case", no_wrap=True)
    for title in ("messages", "events expected", "found", "actions expected", "done", "time"):
        table.add_column(title, justify="right")
    table.add_column("")
    for each in ran:
        verdict = each.verdict
        table.add_row(
            each.name, str(each.messages), str(verdict.expected), str(verdict.found), str(verdict.actions_expected),
            str(verdict.actions_done), f"{each.took_s:.1f} s", _AS_IT_MUST_BE if verdict.as_it_must_be else _DIFFERS,
        )  # fmt: skip
    return table


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m examples.running", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="USE-CASE", help="default: all")
    parser.add_argument("--output", type=Path, metavar="FOLDER", help="keep recordings, events and tasks there")
    parser.add_argument("--record", type=Path, metavar="FILE", help="only write the scenario as an MCAP file")
    parser.add_argument("--pictures", action="store_true", help="only redraw the folders' pictures")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
