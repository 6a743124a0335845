"""What a task wants of an application: that it runs, runs otherwise, or does not run."""

from __future__ import annotations

from enum import StrEnum


class Operation(StrEnum):
    """What a task does while it lives."""

    DEPLOY = "Deploy"
    RECONFIGURE = "Reconfigure"
    SUSPEND = "Suspend"


MEANING = (
    "Deploy: the application runs while any such task lives. Reconfigure: the parameters given replace the merged ones "
    "of what runs; nothing is started. Suspend: what runs is stopped, if no Deploy of higher priority demands it. The "
    "last two need the parameters that the template's key is made from; without any of them they are for all instances."
)
"""The description of the field `operation`."""
