"""Replaces the worker processes in tests about something else: jobs run in the calling process."""

from __future__ import annotations

import pickle
from typing import TypeVar

from application_manager.core.claims.claims import TemplateState
from application_manager.core.conditions import ConditionState
from application_manager.core.demand import drafting
from application_manager.core.objects.ownership import ApplyProblem
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import Rendering
from application_manager.workers.jobs import render_instance
from application_manager.workers.process import Job
from wayside.api import ApplicationInstance, ApplicationTemplate

Result = TypeVar("Result")


class InProcess:
    """Runs jobs."""

    async def run(self, namespace: str, job: Job[Result]) -> Result:
        """The result of the job."""
        return job()


def objects(wanted: ApplicationInstance, template: TemplateState) -> Rendering | ConditionState | None:
    """The instance's objects, or the reason why it has none."""
    if not isinstance(template, ApplicationTemplate):
        return drafting.without_template(wanted, template)
    found = render_instance(pickle.dumps(template), Policy(), wanted)
    if isinstance(found, ApplyProblem):
        return drafting.problem(template, found.reason, found.message)
    assert isinstance(found, Rendering)
    return found
