"""The commands that query a running detector: `detector status`, `evaluate`, `pause` and `resume`.

A command imports what it runs when it runs, so that `--help` need not.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from wayside.beginning import importing
from wayside.commandline import refuse

if TYPE_CHECKING:
    from detector.streams.querying import Reply
    from wayside.api.zenoh import Zenoh

DetectorFile = Annotated[
    Path | None, typer.Option("--detector", help=("The YAML file of the running detector, with its name and network."))
]
Name = Annotated[
    str | None, typer.Option(help=("The holder to query. Default: that of the file, else every detector."))
]
Connect = Annotated[
    list[str] | None, typer.Option(help="Zenoh endpoints, e.g. tcp/127.0.0.1:7447. Default: those of the file.")
]
Timeout = Annotated[float, typer.Option(help="Seconds to wait for responses.", min=0.1)]

RuleName = Annotated[str, typer.Argument(help="The rule's name.", show_default=False)]

_WIDTH = 160
"""Columns of a table that goes into a pipe or a file."""


def status(
    detector: DetectorFile = None,
    name: Name = None,
    connect: Connect = None,
    rule: Annotated[str | None, typer.Option(help="Show only this rule.")] = None,
    subject: Annotated[
        str | None, typer.Option(help=("With --rule: the subject, e.g. car1, car1+car2 or ~fleet. Default: the first."))
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, a line for each detector.")] = False,
    timeout: Timeout = 3.0,
) -> None:
    """Show what running detectors receive, evaluate and lose; for a rule also its values, and what is unknown."""
    if subject is not None and rule is None:
        refuse("--subject requires --rule")
    given = {"rule": rule, "subject": subject, "wait": f"{min(timeout * 0.6, 99):.3f}"} if rule is not None else {}
    answers = inquire(
        "status", {name: value for name, value in given.items() if value is not None}, detector, name, connect, timeout
    )
    if as_json:
        for answer in answers:
            typer.echo(json.dumps(json.loads(answer.payload)))
        return
    with importing():
        from rich.console import Console

        from detector.status.model import read_status
        from detector.status.table import status_view

    console = Console()
    if not console.is_terminal:
        console = Console(width=_WIDTH)
    for answer in answers:
        console.print(status_view(read_status(answer.payload)), highlight=False, markup=False)


def evaluate(
    rule: RuleName, detector: DetectorFile = None, name: Name = None, connect: Connect = None, timeout: Timeout = 3.0
) -> None:
    """Evaluate a rule with onDemand, and print a line of JSON for each subject."""
    for answer in inquire("evaluate", {"rule": rule}, detector, name, connect, timeout):
        for each in json.loads(answer.payload):
            typer.echo(json.dumps(each))


def pause(
    rule: RuleName, detector: DetectorFile = None, name: Name = None, connect: Connect = None, timeout: Timeout = 3.0
) -> None:
    """Do not evaluate a rule until it is resumed; its open episodes are kept."""
    _print_replies("pause", rule, inquire("pause", {"rule": rule}, detector, name, connect, timeout))


def resume(
    rule: RuleName, detector: DetectorFile = None, name: Name = None, connect: Connect = None, timeout: Timeout = 3.0
) -> None:
    """Evaluate a paused rule again."""
    _print_replies("resume", rule, inquire("resume", {"rule": rule}, detector, name, connect, timeout))


def _print_replies(what: str, rule: str, answers: list[Reply]) -> None:
    for answer in answers:
        typer.echo(f"{answer.key.split('/')[2]}: rule {rule} {what}d", err=True)


def inquire(
    what: str,
    given: dict[str, str],
    detector: Path | None,
    name: str | None,
    connect: list[str] | None,
    timeout: float,
    payload: bytes | None = None,
) -> list[Reply]:
    """Query the detectors that the options name. Raises NoAnswerError, NetworkError, DocumentError."""
    with importing():
        from detector.rules.files import load_rules
        from detector.streams.querying import query_detectors
        from wayside.api.pod import DetectorMode
        from wayside.api.zenoh import Zenoh, ZenohMode

    config, holder = Zenoh(mode=ZenohMode.PEER), "*"
    if detector is not None:
        given_detector = load_rules(detector, ()).rule_set.detector
        sidecars = given_detector.spec.mode is DetectorMode.SIDECAR  # each in a pod, which its holder names
        holder = f"{given_detector.name}.$*" if sidecars else given_detector.name
        config = _reaching(given_detector.spec.zenoh)
    if connect:
        config = config.model_copy(update={"connect": connect, "scouting": False, "mode": ZenohMode.CLIENT})
    if not config.connect and not config.scouting:
        refuse("give --connect ENDPOINT, or --detector FILE with the endpoints in spec.zenoh")
    return query_detectors(config, name or holder, what, given, timeout, payload)


def _reaching(zenoh: Zenoh) -> Zenoh:
    """The detector's own way into the network; one that others connect to is reached where it listens."""
    if not zenoh.listen:
        return zenoh
    from wayside.api.zenoh import ZenohMode

    here = [endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:") for endpoint in zenoh.listen]
    return zenoh.model_copy(update={"connect": here, "listen": [], "mode": ZenohMode.CLIENT})
