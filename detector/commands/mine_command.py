"""The command `detector mine`; its implementation is imported when it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from wayside.process.startup import importing


def mine(
    recordings: Annotated[
        list[str],
        typer.Argument(
            help="Recordings of any kind that replay reads, except intake files; folders and patterns of these; URLs "
            "(s3://, https://); @FILE for a file with one of these on each line."
        ),
    ],
    detector: Annotated[Path, typer.Option(help="A YAML file with one Detector.")],
    rules: Annotated[list[Path], typer.Option(help="YAML files or folders with EventRules; may be repeated.")],
    output: Annotated[
        Path, typer.Option(help="The folder of the dataset. Recordings that it already contains are not mined again.")
    ],
    processes: Annotated[
        int | None, typer.Option(min=1, help="The number of recordings to mine at once. Default: one for each core.")
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Let a Dask cluster do the work, e.g. tcp://127.0.0.1:8786."),
    ] = None,
    record: Annotated[
        bool, typer.Option("--record", help="Run the rules' record actions, into the folder clips of the output.")
    ] = False,
    sample: Annotated[
        int | None,
        typer.Option(min=1, help="Mine only this number of recordings, chosen at random, but the same ones each time."),
    ] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Mine only the first recordings, by name.")] = None,
    share: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBER/OF",
            help="Mine one share of the recordings, e.g. 0/8, while other machines mine 1/8 to 7/8 with the same "
            "output. The last one to finish writes the dataset.",
        ),
    ] = None,
) -> None:
    """Run rules over many recordings, each by itself, and write one dataset of Parquet files."""
    with importing():
        from detector.commands.mine import mine_recordings

    mine_recordings(
        recordings,
        output,
        detector,
        rules,
        processes=processes,
        dask=dask,
        record=record,
        sample=sample,
        limit=limit,
        share=share,
    )
