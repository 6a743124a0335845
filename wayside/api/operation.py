"""The operation of a task: deploy, reconfigure or suspend an application."""

from __future__ import annotations

from enum import StrEnum


class Operation(StrEnum):
    """The effect of a task while it is live."""

    DEPLOY = "Deploy"
    RECONFIGURE = "Reconfigure"
    SUSPEND = "Suspend"


MEANING = (
    "Deploy: the application runs while any Deploy task is live. Reconfigure: the parameters replace the merged "
    "parameters of running instances; nothing is started. Suspend: running instances are stopped, unless a Deploy "
    "task of higher priority demands them. Reconfigure and Suspend select an instance by the parameters that "
    "the template's key refers to; without any of these parameters, they apply to all instances."
)
"""The description of the field `operation`."""
