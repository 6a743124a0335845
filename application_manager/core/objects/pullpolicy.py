"""When a node pulls an image. Imports nothing, since the command line needs it for `--help`. Pure."""

from __future__ import annotations

from enum import StrEnum


class PullPolicy(StrEnum):
    """When a node pulls an image, as Kubernetes names it."""

    ALWAYS = "Always"
    IF_NOT_PRESENT = "IfNotPresent"
    NEVER = "Never"
