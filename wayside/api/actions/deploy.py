"""The deploy action: demands an application while an episode lasts."""

from __future__ import annotations

from pydantic import Field

from wayside.api.base import Model, TemplateName
from wayside.api.freedata import NamedData
from wayside.api.operation import MEANING, Operation


class Deploy(Model):
    """Deploys, reconfigures or suspends an application while the episode lasts."""

    template_name: TemplateName
    """The name of the ApplicationTemplate, in the namespace of the rule."""
    operation: Operation = Field(default=Operation.DEPLOY, description=MEANING)
    priority: int = Field(default=0, ge=-1_000_000, le=1_000_000)
    """The priority of the task. Higher priorities come first; tasks of equal priority are ordered by creation time,
    then by name."""
    parameters: NamedData = Field(default_factory=dict)
    """The values for the template's parameters. They can contain ${…} with the rule's variables at the start of the
    episode."""
    follow: bool = False
    """If true, each evaluation during the episode computes the parameters again, and patches the task when they change.
    A parameter that becomes unknown, or whose expression fails, keeps its last value."""
