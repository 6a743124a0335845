"""`application-manager check`: what admission would say of files, with file, line and column. Without a cluster."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from application_manager.core.findings.demanding import deploy_remarks
from application_manager.core.findings.findings import Findings, field_of
from application_manager.core.findings.rulefindings import detector_findings, rule_findings
from application_manager.core.findings.templatefindings import template_findings
from application_manager.core.objects.policy import Policy
from wayside.api import ApplicationTemplate, Detector, EventRule
from wayside.api.base import Kind
from wayside.api.documents import Document, FieldPath, field_text, load_documents


@dataclass(frozen=True, slots=True)
class Checked:
    """What was found.

    Attributes:
        problems: what would be refused, a line each.
        warnings: what would be warned of, a line each.
        looked_at: how many objects.
    """

    problems: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    looked_at: int = 0


def check_files(paths: Iterable[Path], policy: Policy) -> Checked:
    """Look at the templates, rules and detectors in the files, each with all others of its namespace among them.

    Raises DocumentError for files that cannot be read as our kinds.
    """
    documents = load_documents(paths)
    found = {index: _findings(each.object, documents, policy) for index, each in enumerate(documents)}
    judged = [(documents[index], each) for index, each in found.items() if each is not None]
    return Checked(
        [line for document, findings in judged for line in _lines(document, findings.problems)],
        [line for document, findings in judged for line in _lines(document, findings.warnings)],
        len(judged),
    )


def _findings(about: Kind, documents: Sequence[Document], policy: Policy) -> Findings | None:
    """What is wrong with the object; None for a kind that is not looked at."""
    match about:
        case ApplicationTemplate():
            return template_findings(about, policy)
        case Detector():
            return detector_findings(about)
        case EventRule():
            here = [each.object for each in documents if each.object.namespace == about.namespace]
            detectors = [each for each in here if isinstance(each, Detector)]
            rules = [each for each in here if isinstance(each, EventRule)]
            templates = [each for each in here if isinstance(each, ApplicationTemplate)]
            # Rules are often kept apart from all templates: without any there is nothing to be said.
            remarks = deploy_remarks(about, templates) if templates else []
            return replace(rule_findings(about, detectors, (), rules), remarks=tuple(remarks))
    return None


def _lines(document: Document, findings: Iterable[str]) -> list[str]:
    marks = {field_text(path): path for path in document.marks}
    what = f"{type(document.object).__name__} {document.object.name}"
    lines = []
    for finding in findings:
        problem = document.problem(_path(field_of(finding), marks), finding)
        lines.append(f"{problem.file}:{problem.line}:{problem.column}: {what}: {finding}")
    return lines


def _path(written: str, marks: Mapping[str, FieldPath]) -> FieldPath:
    """The field's path, or that of its closest ancestor in the file."""
    above = [text for text in marks if written == text or (written.startswith(text) and written[len(text)] in ".[")]
    return marks[max(above, key=len)] if above else ()
