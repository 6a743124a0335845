"""A Detector and its EventRules from YAML files, which SIGHUP makes a running detector read again."""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from detector.resources.selection import RuleSet, select
from wayside.api import Detector, EventRule
from wayside.api.documents import Document, DocumentError, Problem, load_documents
from wayside.rules import RuleProblem


@dataclass(frozen=True)
class FileRules:
    """The content of the files."""

    rule_set: RuleSet
    detector: Document
    rules: dict[str, Document]
    """The selected rules by name, for the places of errors."""
    warnings: tuple[str, ...]
    """Rules that were given but are not evaluated, and why."""


Check = Callable[[Detector], Iterable[RuleProblem]]


def load_rules(detector: str | Path, rules: Iterable[str | Path], check: Check = lambda _: ()) -> FileRules:
    """Read exactly one Detector, and the rules that it selects.

    Args:
        detector: a file or folder. Other kinds in it are ignored.
        rules: files or folders, likewise. EventRules beside the detector count only if they are given here.
        check: returns the problems that keep the Detector from running.

    Raises:
        DocumentError: with every problem of every file; also if there is no Detector, or more than one, or two
            rules of the same name.
    """
    problems: list[Problem] = []
    beside_detector = _load([detector], problems)
    given = _load(rules, problems)
    detectors = [document for document in beside_detector if isinstance(document.object, Detector)]
    if not problems and len(detectors) != 1:
        problems.extend(_not_one(str(detector), detectors))
    for document in () if problems else detectors:
        assert isinstance(document.object, Detector)  # noqa: S101  picked above
        problems.extend(document.problem(each.path, each.message) for each in check(document.object))
    documents: dict[str, Document] = {}
    for document in given:
        if not isinstance(document.object, EventRule):
            continue
        first = documents.setdefault(document.object.name, document)
        if first is not document:
            where = f"{first.file}:{first.line}"
            problems.append(
                document.problem(
                    ("metadata", "name"),
                    f"the EventRule {first.object.name!r} is also in {where}: rename or remove one",
                )
            )
    if problems:
        raise DocumentError(problems)
    return _selected(detectors[0], documents)


def load_detectors(given: str | Path) -> list[Detector]:
    """Read all Detectors of a file or folder, at least one. Raises DocumentError."""
    problems: list[Problem] = []
    documents = _load([given], problems)
    detectors = [document.object for document in documents if isinstance(document.object, Detector)]
    if not problems and not detectors:
        problems.extend(_not_one(str(given), []))
    if problems:
        raise DocumentError(problems)
    return detectors


def _selected(detector: Document, documents: dict[str, Document]) -> FileRules:
    assert isinstance(detector.object, Detector)  # noqa: S101  the caller picked it
    candidates = [document.object for document in documents.values() if isinstance(document.object, EventRule)]
    rule_set = select(detector.object, candidates)
    chosen = {rule.name: documents[rule.name] for rule in rule_set.rules}
    return FileRules(rule_set, detector, chosen, tuple(_left_out(documents, chosen, detector.object)))


def _left_out(documents: dict[str, Document], chosen: dict[str, Document], detector: Detector) -> Iterable[str]:
    for name, document in documents.items():
        if name in chosen:
            continue
        rule = document.object
        if rule.namespace != detector.namespace:
            why = (
                f"it is in namespace {rule.namespace!r}, the Detector {detector.name!r} in "
                f"{detector.namespace!r}: a detector evaluates only rules of its own namespace"
            )
            yield str(document.problem(("metadata", "namespace"), f"the EventRule {name!r} is not evaluated: {why}"))
        else:
            selected = f"the Detector {detector.name!r} selects by labels: {detector.spec.rule_selector}"
            why = f"{selected}: correct metadata.labels"
            yield str(document.problem(("metadata", "labels"), f"the EventRule {name!r} is not evaluated: {why}"))


def _load(paths: Iterable[str | Path], problems: list[Problem]) -> list[Document]:
    try:
        return load_documents(paths)
    except DocumentError as error:
        problems.extend(problem for problem in error.problems if problem not in problems)
        return []


def _not_one(given: str, detectors: list[Document]) -> Iterable[Problem]:
    if not detectors:
        yield Problem(given, 0, 0, "", "contains no Detector: give one object of kind: Detector")
    for document in detectors[1:]:
        yield document.problem(("metadata", "name"), "is a second Detector: give only one")


_log = logging.getLogger(__name__)


def hangups() -> asyncio.Event:
    """An event that every SIGHUP sets from now on. Call it before the files are first read, or a signal may be lost."""
    changed = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, changed.set)
    return changed


async def follow_files(
    detector: Path, rules: Sequence[Path], check: Check, changed: asyncio.Event
) -> AsyncIterator[RuleSet]:
    """The content of the files each time `changed` is set. Invalid files are logged and change nothing."""
    try:
        while True:
            await changed.wait()
            changed.clear()
            try:
                loaded = load_rules(detector, rules, check)
            except (DocumentError, OSError) as error:
                _log.error("cannot watch the files; keeping the last good version: %s", error)
                continue
            for warning in loaded.warnings:
                _log.warning("%s", warning)
            _log.info("reloaded the files: %d rules", len(loaded.rule_set.rules))
            yield loaded.rule_set
    finally:
        asyncio.get_running_loop().remove_signal_handler(signal.SIGHUP)
