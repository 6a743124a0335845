"""Computes claims, in a worker process if that evaluates an expression or a pattern of the template.

A key that only concatenates parameters (`${parameters.region}-${parameters.lane}`) is computed immediately: it costs no
more than sending it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from application_manager.core.claims.claims import Claim, Refusal, RefusalReason, TemplateState, claim
from application_manager.core.claims.operations import Verdict, VerdictKind
from application_manager.core.demand.demand import claim_or_verdict, finished, refused
from application_manager.core.objects.policy import Name
from application_manager.core.objects.trimming import without_objects
from application_manager.workers.answers import AnswerCache, Exceeded
from application_manager.workers.jobs import claims_are_plain
from wayside.api import ApplicationTask, ApplicationTemplate


def evaluate_claim(
    answers: AnswerCache, done: Callable[[Name], None], template: TemplateState, task: ApplicationTask
) -> Claim | Verdict | None:
    """The claim of the task, or its verdict if it claims nothing; None while that is being computed.

    `done` is called with the task once its claim is available.
    """
    if not isinstance(template, ApplicationTemplate) or claims_are_plain(template):
        return claim_or_verdict(template, task)
    over = finished(task)
    if over is not None:
        return over
    name = (task.namespace, task.name)
    metadata, spec = template.metadata, task.spec
    found = answers.answer(
        key=("claim", *name),
        question=(metadata.uid, metadata.generation, task.metadata.uid, spec.operation, spec.parameters),
        namespace=task.namespace,
        job=lambda: partial(claim, without_objects(template), task),
        done=partial(done, name),
    )
    match found:
        case Claim():
            return replace(found, task=task)
        case Refusal():
            return refused(found)
        case Exceeded(message):
            what = f"spec.parameters: checking them against template {template.name}"
            return Verdict(VerdictKind.REFUSED, RefusalReason.EXPRESSION_LIMIT, f"{what} {message}")
    return None
