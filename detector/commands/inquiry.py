"""The commands that query a running detector: `detector status`, `evaluate`, `pause` and `resume`.

A command imports its implementation when it runs, so that `--help` stays fast.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from wayside.process.commandline import refuse, table_console
from wayside.process.startup import importing

if TYPE_CHECKING:
    from rich.console import RenderableType

    from detector.streams.query_handler import Reply
    from wayside.api.zenoh import Zenoh

DetectorFile = Annotated[
    Path | None, typer.Option("--detector", help=("The YAML file of the running detector, with its name and network."))
]
Name = Annotated[
    str | None, typer.Option(help=("The holder to query. Default: the holder in the file, else every detector."))
]
Connect = Annotated[
    list[str] | None, typer.Option(help="Zenoh endpoints, e.g. tcp/127.0.0.1:7447. Default: those in the file.")
]
Timeout = Annotated[float, typer.Option(help="Seconds to wait for responses.", min=0.1)]

RuleName = Annotated[str, typer.Argument(help="The rule's name.", show_default=False)]


def status(
    detector: DetectorFile = None,
    name: Name = None,
    connect: Connect = None,
    rule: Annotated[str | None, typer.Option(help="Show only this rule.")] = None,
    subject: Annotated[
        str | None,
        typer.Option(help="With --rule: the subject, e.g. car1, car1+car2 or ~fleet. Default: the first 20."),
    ] = None,
    everything: Annotated[
        bool,
        typer.Option(
            "--all",
            help="Print totals over all detectors: those in the file, which may contain several, else every detector.",
        ),
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON, a line for each detector; with --all one line.")
    ] = False,
    timeout: Timeout = 3.0,
) -> None:
    """Show what running detectors receive, evaluate and lose; for a rule also its values, and which are unknown."""
    if everything:
        if name is not None or subject is not None:
            refuse(f"--all prints totals over all detectors: remove {'--name' if name is not None else '--subject'}")
        _show_total(detector, connect, rule, timeout, as_json)
        return
    if subject is not None and rule is None:
        refuse("--subject requires --rule")
    given = {"rule": rule, "subject": subject, "wait": f"{min(timeout * 0.6, 99):.3f}"} if rule is not None else {}
    answers = query_selected(
        "status", {name: value for name, value in given.items() if value is not None}, detector, name, connect, timeout
    )
    if as_json:
        for answer in answers:
            typer.echo(json.dumps(json.loads(answer.payload)))
        return
    with importing():
        from detector.status.model import read_status
        from detector.status.table import status_view

    for answer in answers:
        _print_view(status_view(read_status(answer.payload)))


def _show_total(
    detector: Path | None, connect: list[str] | None, rule: str | None, timeout: float, as_json: bool
) -> None:
    """Print the sum. Ends with exit code 1 if a detector of the file does not respond."""
    with importing():
        from detector.status.model import read_status, to_json
        from detector.status.table import total_view
        from detector.status.total import only_rule, total

    answers, missing = _inquire_all(detector, connect, timeout)
    added = total(map(read_status, answers), missing)
    if rule is not None:
        if all(each.name != rule for each in added.rules):
            known = ", ".join(sorted(each.name for each in added.rules)) or "none"
            refuse(f"--rule {rule}: no detector has this rule; the rules are {known}")
        added = only_rule(added, rule)
    if as_json:
        typer.echo(to_json(added))
    else:
        _print_view(total_view(added))
    for holder, why in missing.items():
        typer.echo(f"detector: {holder} is not in the totals: {why}", err=True)
    if missing:
        raise typer.Exit(1)


def _inquire_all(
    detector: Path | None, connect: list[str] | None, timeout: float
) -> tuple[list[bytes], dict[str, str]]:
    """The statuses of the file's detectors, else of every detector; and why detectors of the file did not respond.

    Each network of the file's Detectors is queried separately: regions may have separate networks.

    Raises:
        NoAnswerError: no detector responds.
        NetworkError: without a file: no session.
        DocumentError: the file is wrong, or contains no Detector.
    """
    if detector is None:
        return [answer.payload for answer in query_selected("status", {}, None, None, connect, timeout)], {}
    with importing():
        from detector.resources.files import load_detectors
        from detector.streams.query_handler import NoAnswerError, query_detectors
        from detector.streams.session import NetworkError
        from wayside.api.pod import DetectorMode

    networks: list[tuple[Zenoh, list[str]]] = []
    for each in load_detectors(detector):
        holder = f"{each.name}.*" if each.spec.mode is DetectorMode.SIDECAR else each.name
        config = _through(_reaching(each.spec.zenoh), connect)
        for known, holders in networks:
            if known == config:
                holders.append(holder)
                break
        else:
            networks.append((config, [holder]))
    payloads: list[bytes] = []
    missing: dict[str, str] = {}
    for config, holders in networks:
        where = ", ".join(config.connect) or "the local network"
        why = f"no response at {where} within {timeout:g} s: is it running, and is this its Zenoh network?"
        replies: list[Reply] = []
        try:
            replies = query_detectors(config, "*", "status", {}, timeout, complete=partial(_all_answer, holders))
        except NoAnswerError:
            pass
        except NetworkError as error:
            why = str(error)
        payloads += [reply.payload for reply in replies if any(fnmatchcase(reply.holder, each) for each in holders)]
        missing |= {each: why for each in holders if not _all_answer([each], replies)}
    if not payloads:
        raise NoAnswerError("no detector answers: " + "; ".join(f"{each}: {why}" for each, why in missing.items()))
    return payloads, missing


def _all_answer(holders: Iterable[str], replies: Sequence[Reply]) -> bool:
    return all(any(fnmatchcase(reply.holder, each) for reply in replies) for each in holders)


def _print_view(view: RenderableType) -> None:
    with importing():
        console = table_console()
    console.print(view, highlight=False, markup=False)


def evaluate(
    rule: RuleName, detector: DetectorFile = None, name: Name = None, connect: Connect = None, timeout: Timeout = 3.0
) -> None:
    """Evaluate a rule with onDemand, and print a line of JSON for each subject."""
    for answer in query_selected("evaluate", {"rule": rule}, detector, name, connect, timeout):
        for each in json.loads(answer.payload):
            typer.echo(json.dumps(each))


def pause(
    rule: RuleName, detector: DetectorFile = None, name: Name = None, connect: Connect = None, timeout: Timeout = 3.0
) -> None:
    """Do not evaluate a rule until it is resumed; its open episodes are kept."""
    _print_replies("pause", rule, query_selected("pause", {"rule": rule}, detector, name, connect, timeout))


def resume(
    rule: RuleName, detector: DetectorFile = None, name: Name = None, connect: Connect = None, timeout: Timeout = 3.0
) -> None:
    """Evaluate a paused rule again."""
    _print_replies("resume", rule, query_selected("resume", {"rule": rule}, detector, name, connect, timeout))


def _print_replies(what: str, rule: str, answers: list[Reply]) -> None:
    for answer in answers:
        typer.echo(f"{answer.holder}: rule {rule} {what}d", err=True)


def query_selected(
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
        from detector.resources.files import load_rules
        from detector.streams.query_handler import query_detectors
        from wayside.api.pod import DetectorMode
        from wayside.api.zenoh import Zenoh, ZenohMode

    config, holder = Zenoh(mode=ZenohMode.PEER), "*"
    if detector is not None:
        given_detector = load_rules(detector, ()).rule_set.detector
        sidecars = given_detector.spec.mode is DetectorMode.SIDECAR  # each in a pod, whose name is part of the holder
        holder = f"{given_detector.name}.$*" if sidecars else given_detector.name
        config = _reaching(given_detector.spec.zenoh)
    config = _through(config, connect)
    if not config.connect and not config.scouting:
        refuse("give --connect ENDPOINT, or --detector FILE with the endpoints in spec.zenoh")
    return query_detectors(config, name or holder, what, given, timeout, payload)


def _through(zenoh: Zenoh, connect: list[str] | None) -> Zenoh:
    """The network configuration with these endpoints, if any are given."""
    from wayside.api.zenoh import ZenohMode

    return (
        zenoh.model_copy(update={"connect": connect, "scouting": False, "mode": ZenohMode.CLIENT}) if connect else zenoh
    )


def _reaching(zenoh: Zenoh) -> Zenoh:
    """The detector's own network configuration; a detector that listens is reached at its listening endpoint."""
    if not zenoh.listen:
        return zenoh
    from wayside.api.zenoh import ZenohMode

    here = [endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:") for endpoint in zenoh.listen]
    return zenoh.model_copy(update={"connect": here, "listen": [], "mode": ZenohMode.CLIENT})
