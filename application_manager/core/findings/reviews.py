"""AdmissionReviews: the requests of the API server before it stores an object, and the responses. Pure.

Only a new spec can be refused. A change that leaves the spec unchanged passes, even if the object is invalid: otherwise
nobody could label it, and a finalizer could never be removed. A deletion passes, and so does a change of an object that
is being deleted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

from application_manager.core.conditions import cut
from application_manager.core.findings.findings import Findings, field_of
from wayside.api.base import API_VERSION, GROUP
from wayside.findings import IGNORE_ANNOTATION, ignored_by

REVIEW_VERSION = "admission.k8s.io/v1"
REVIEWED = {"ApplicationTemplate": "applicationtemplates", "Detector": "detectors", "EventRule": "eventrules"}
"""The kinds that are reviewed, and their resources.

Never tasks and instances: an outage or a defect of the manager must not prevent the end of a demand.
"""

MOST_REPORTED = 16  # problems, and warnings, of one response; each warning is an HTTP header
LONGEST = 1024  # characters of each

Json = dict[str, Any]


class ReviewError(ValueError):
    """The request is not a valid AdmissionReview."""


class OverloadedError(Exception):
    """Too many reviews are in progress."""


class ReviewEffect(Enum):
    """The effect of findings on a review."""

    NONE = "not checked"
    WARNED = "warned of"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True)
class Request:
    """A review request of the API server.

    Attributes:
        kind: of the object; empty if that is not reviewed.
        object: as it would be stored; empty for a deletion.
        old: as it is stored; None for a new one.
        effect: the effect of problems.
    """

    uid: str
    kind: str
    namespace: str
    object: Json
    old: Json | None
    effect: ReviewEffect


def request_in(review: Any) -> Json:
    """The `request` of an AdmissionReview, with its uid. Raises ReviewError."""
    if not isinstance(review, dict) or review.get("apiVersion") != REVIEW_VERSION:
        raise ReviewError(f"is not an AdmissionReview of {REVIEW_VERSION}: only the API server may call this path")
    raw = review.get("request")
    if not isinstance(raw, dict) or not isinstance(raw.get("uid"), str):
        raise ReviewError("request.uid: is missing: only the API server may call this path")
    return raw


def read(review: Any) -> Request:
    """The review request in an AdmissionReview. Raises ReviewError."""
    raw = request_in(review)
    kind, new, old = (raw.get(name) for name in ("kind", "object", "oldObject"))
    kind = kind if isinstance(kind, dict) else {}
    new = dict(new) if isinstance(new, dict) else {}
    old = old if isinstance(old, dict) else None
    ours = kind.get("group") == GROUP and kind.get("kind") in REVIEWED
    name, namespace = str(kind["kind"]) if ours else "", _line(str(raw.get("namespace") or ""))
    if ours and new:
        new |= {"apiVersion": API_VERSION, "kind": name}
        named = {"name": raw.get("name") or "unnamed", **_metadata(new), "namespace": namespace}
        new["metadata"] = named
    effect = _effect(raw, new, old) if ours else ReviewEffect.NONE
    return Request(raw["uid"], name, namespace, new, old, effect)


def _effect(raw: Mapping[str, Any], new: Json, old: Json | None) -> ReviewEffect:
    operation = raw.get("operation")
    if operation not in ("CREATE", "UPDATE") or raw.get("subResource") or not new:
        return ReviewEffect.NONE
    if _metadata(new).get("deletionTimestamp"):
        return ReviewEffect.NONE
    if operation == "CREATE" or old is None or new.get("spec") != old.get("spec"):
        return ReviewEffect.REFUSED
    # Labels determine which Detectors select a rule.
    return ReviewEffect.WARNED if _metadata(new).get("labels") != _metadata(old).get("labels") else ReviewEffect.NONE


def answer(request: Request, findings: Findings) -> Json:
    """The AdmissionReview of the response."""
    if request.effect is ReviewEffect.NONE:
        findings = Findings()
    refused = request.effect is ReviewEffect.REFUSED and bool(findings.problems)
    response: Json = {"uid": request.uid, "allowed": not refused}
    warnings = findings.warnings(_ignored(request.object))
    if not refused:
        warnings = *findings.problems, *warnings
    if warnings:
        response["warnings"] = shortened(warnings)
    if refused:
        problems = shortened(findings.problems)
        response["status"] = {
            "status": "Failure",
            "code": 422,
            "reason": "Invalid",
            "message": "; ".join(problems),
            "details": {
                "group": GROUP,
                "kind": request.kind,
                "name": _line(str(_metadata(request.object).get("name", ""))),
                "causes": [_cause(each) for each in problems],
            },
        }
    return {"apiVersion": REVIEW_VERSION, "kind": "AdmissionReview", "response": response}


def _cause(problem: str) -> Json:
    field = field_of(problem)
    message = problem.removeprefix(field).lstrip(":, ")
    return {"reason": "FieldValueInvalid", "field": field or "spec", "message": message}


def shortened(texts: tuple[str, ...]) -> list[str]:
    """The first texts, in a form that HTTP headers can contain, and the number of the others."""
    lines = [_line(each) for each in texts[:MOST_REPORTED]]
    left = len(texts) - len(lines)
    return [*lines, f"and {left} more: correct these first"] if left else lines


def _ignored(raw: Json) -> frozenset[str]:
    """The names of the warnings that the object's annotation ignores."""
    annotations = _metadata(raw).get("annotations")
    names = annotations.get(IGNORE_ANNOTATION) if isinstance(annotations, dict) else None
    return ignored_by({IGNORE_ANNOTATION: names}) if isinstance(names, str) else frozenset()


def _line(text: str) -> str:
    line = " ".join("".join(sign if sign.isprintable() else " " for sign in text).split())
    return cut(line, LONGEST)


def _metadata(raw: Mapping[str, Any]) -> Json:
    metadata = raw.get("metadata")
    return metadata if isinstance(metadata, dict) else {}
