"""While the claim of a task is being computed, no decision treats it as absent."""

from __future__ import annotations

from functools import partial
from typing import Any

from application_manager.cache.claim_index import ClaimIndex
from application_manager.cache.store import Entry
from application_manager.core.claims.claims import Claim, RefusalReason
from application_manager.core.claims.operations import Verdict, VerdictKind
from application_manager.core.demand.demand import claim_or_verdict
from application_manager.workers.answers import Exceeded
from application_manager.workers.claiming import evaluate_claim
from wayside.api import ApplicationTask, ApplicationTemplate

NAME = ("site", "a")
OF = ("site", "app")
CONFIG = {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "${instance.name}"}}


def template(key: str = "${parameters.region}", **parameter: Any) -> ApplicationTemplate:
    spec = {"parameters": {"region": {"type": "string", **parameter}}, "key": key, "manifests": [CONFIG]}
    metadata = {"name": "app", "namespace": "site", "uid": "t", "generation": 1}
    made = {"kind": "ApplicationTemplate", "metadata": metadata, "spec": spec}
    return ApplicationTemplate.model_validate(made)


def task(region: str = "north", *, ended: bool = False) -> ApplicationTask:
    spec: dict[str, Any] = {"templateName": "app", "parameters": {"region": region}}
    if ended:
        spec["endTime"] = "2026-01-01T00:00:00Z"
    return ApplicationTask.model_validate(
        {"kind": "ApplicationTask", "metadata": {"name": "a", "namespace": "site", "uid": "u"}, "spec": spec}
    )


class Answers:
    """In place of the cache of answers: has the answer that is put in."""

    def __init__(self) -> None:
        self.found: object | None = None
        self.requested = 0

    def answer(self, **_: object) -> object | None:
        self.requested += 1
        return self.found


def index_of(answers: Answers) -> ClaimIndex:
    return ClaimIndex(partial(evaluate_claim, answers, lambda _: None))  # type: ignore[arg-type]  it has what is used


def test_a_key_of_plain_parameters_is_computed_inline_and_others_in_workers() -> None:
    for key in ("${parameters.region}", "lane-${ parameters.region }", "fixed"):
        answers = Answers()
        index_of(answers).note(NAME, Entry({}, task()), template(key))
        assert not answers.requested
    for made in (
        template("${parameters.region + 'x'}"),
        template("${[parameters.region].filter(x, x.matches('a'))[0]}"),
        template(pattern="^[a-z]+$"),
    ):
        answers = Answers()
        index_of(answers).note(NAME, Entry({}, task()), made)
        assert answers.requested


def test_a_task_keeps_its_old_claim_until_the_new_one_is_known() -> None:
    answers = Answers()
    index, made = index_of(answers), template(pattern="^[a-z]+$")
    first = claim_or_verdict(made, task())
    assert isinstance(first, Claim)
    assert index.note(NAME, Entry({}, task()), made) == set()
    assert index.pending(OF)
    answers.found = first
    assert index.note(NAME, Entry({}, task()), made) == {("site", first.instance)}
    assert not index.pending(OF)
    answers.found = None
    index.note(NAME, Entry({}, task()), made)
    assert index.claim(NAME) == first
    assert index.pending(OF)
    index.note(NAME, Entry({}, task(ended=True)), made)
    verdict = index.verdict(NAME)
    assert verdict is not None
    assert (verdict.kind, index.claim(NAME), index.pending(OF)) == (VerdictKind.FINISHED, None, False)


def test_a_template_is_unsettled_until_the_claims_of_all_existing_tasks_are_known() -> None:
    answers = Answers()
    resolved: list[tuple[str, str]] = []
    index, made = index_of(answers), template(pattern="^[a-z]+$")
    index.resolved = resolved.append
    index.note(NAME, Entry({}, task()), made)
    index.note(("site", "b"), Entry({}, task("south")), made)
    index.begin()
    index.note(("site", "later"), Entry({}, task("west")), made)
    assert index.unresolved(OF)
    answers.found = claim_or_verdict(made, task())
    index.note(NAME, Entry({}, task()), made)
    assert index.unresolved(OF)
    index.forget(("site", "b"))
    assert (index.unresolved(OF), resolved) == (False, [OF])
    assert index.pending(OF)  # the later one, which nothing can run for yet


def test_a_claim_that_times_out_is_rejected_and_leaves_the_template_unsettled() -> None:
    answers = Answers()
    index, made = index_of(answers), template(pattern="^[a-z]+$")
    index.note(NAME, Entry({}, task()), made)
    index.begin()
    answers.found = Exceeded("takes more than 2 s of CPU time and was ended")
    index.note(NAME, Entry({}, task()), made)
    verdict = index.verdict(NAME)
    assert isinstance(verdict, Verdict)
    assert (verdict.kind, verdict.reason) == (VerdictKind.REFUSED, RefusalReason.EXPRESSION_LIMIT)
    assert "against template app takes more than 2 s" in verdict.message
    assert index.unresolved(OF)
    index.note(NAME, Entry({}, task(ended=True)), made)
    assert not index.unresolved(OF)
