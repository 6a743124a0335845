"""`application-manager check`: the findings of admission for files, with line and column. Needs no cluster."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from pathlib import Path

from application_manager.core.findings.checks import INVALID_RULE, INVALID_TEMPLATE
from application_manager.core.findings.findings import Findings, field_of
from application_manager.core.findings.rulefindings import RuleContext, detector_findings
from application_manager.core.findings.templatefindings import template_findings
from application_manager.core.objects.policy import Policy
from wayside.api import ApplicationTemplate, Detector, EventRule
from wayside.api.base import Kind
from wayside.api.documents import Document, FieldPath, field_text, load_documents
from wayside.findings import INVALID_DETECTOR, Check, Finding

_INVALID: Mapping[type[Kind], Check] = {
    ApplicationTemplate: INVALID_TEMPLATE,
    Detector: INVALID_DETECTOR,
    EventRule: INVALID_RULE,
}


@dataclass(slots=True)
class Checked:
    """The refusals and the warnings, one line each, and the number of checked objects."""

    problems: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    objects: int = 0


def review_files(paths: Iterable[Path], policy: Policy, ignored: Set[str] = frozenset()) -> Checked:
    """Check the templates, rules and detectors in the files, each together with all others of its namespace.

    Warnings whose names are in `ignored`, or in the annotation of their object, are left out. Raises DocumentError for
    files that cannot be read as our kinds.
    """
    documents = load_documents(paths)
    checked = Checked()
    for document in documents:
        findings = _findings(document.object, documents, policy)
        if findings is None:
            continue
        checked.objects += 1
        name = _INVALID[type(document.object)].name
        checked.problems += _lines(document, [Finding(name, each) for each in findings.problems])
        found = dict.fromkeys((*findings.doubts, *findings.remarks))
        shown = [each for each in found if each.check not in ignored and not document.ignores(each.check)]
        checked.warnings += _lines(document, shown)
    return checked


def _findings(about: Kind, documents: Sequence[Document], policy: Policy) -> Findings | None:
    """The findings about the object; None for a kind that is not checked."""
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
            found = RuleContext(detectors, rules=rules, templates=templates).findings(about)
            # Rules are often kept apart from templates: without any template, there is nothing to check.
            return found if templates else replace(found, remarks=())
    return None


def _lines(document: Document, findings: Iterable[Finding]) -> list[str]:
    marks = {field_text(path): path for path in document.marks}
    what = f"{type(document.object).__name__} {document.object.name}"
    lines = []
    for finding in findings:
        problem = document.problem(_path(field_of(finding.text), marks), finding.text)
        lines.append(f"{problem.file}:{problem.line}:{problem.column}: {what}: {finding} [{finding.check}]")
    return lines


def _path(written: str, marks: Mapping[str, FieldPath]) -> FieldPath:
    """The field's path, or that of its closest ancestor in the file."""
    above = [text for text in marks if written == text or (written.startswith(text) and written[len(text)] in ".[")]
    return marks[max(above, key=len)] if above else ()
