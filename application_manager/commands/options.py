"""Parses and checks options; an error names its option (typer.BadParameter).

The modules of the parsed values are imported on use, like all that a command runs.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from wayside.process import commandline

if TYPE_CHECKING:
    from application_manager.admission.webhook import WebhookOptions
    from application_manager.cluster.leadership import LeaseKey
    from application_manager.core.holders.policies import TaskPolicy
    from application_manager.core.objects.poddefaults import PodDefaults
    from application_manager.core.objects.policy import Policy


class PullPolicy(StrEnum):
    """When a node pulls an image, as Kubernetes names it."""

    ALWAYS = "Always"
    IF_NOT_PRESENT = "IfNotPresent"
    NEVER = "Never"


@contextmanager
def checking(option: str) -> Iterator[None]:
    """Report a ValueError of the block as an error of this option."""
    try:
        yield
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint=option) from None


def seconds_of(option: str, written: str) -> float:
    """The duration of an option, in seconds."""
    from wayside.api.base import Duration

    with checking(option):
        return Duration.parse(written).seconds


def option_bytes(option: str, written: str) -> int:
    """The quantity of an option, in bytes."""
    from wayside.api.base import PositiveQuantity

    with checking(option):
        return PositiveQuantity.parse(written).bytes


def policy_of(kinds: list[str] | None, accounts: list[str] | None, *, everywhere: bool = False) -> Policy:
    """The policy; `everywhere`: for a manager of all namespaces."""
    from application_manager.core.objects.policy import Policy

    with checking("--allowed-kinds"):
        policy = Policy.parse(kinds, accounts)
        if everywhere:
            policy.check_everywhere()
        return policy


def tasks_of(most: int | None, holders: list[str] | None) -> TaskPolicy:
    """The limits of tasks: of `--max-tasks` and `--holder-policy`."""
    from application_manager.core.holders.policies import HolderPolicy, TaskPolicy

    with checking("--holder-policy"):
        return TaskPolicy(most, tuple(HolderPolicy.parse(each) for each in holders or ()))


def webhook_of(
    port: int | None, certificates: Path | None, service: str | None, webhooks: str
) -> WebhookOptions | None:
    """The settings of the webhook; None: do not serve it."""
    if port is None and certificates is None and service is None:
        return None
    from application_manager.admission.webhook import FOLDER_OPTION, PORT_OPTION, WebhookOptions
    from application_manager.core.findings.webhooks import certificate_secret

    if port is None or certificates is None:
        commandline.refuse(f"give both {PORT_OPTION} and {FOLDER_OPTION}, or neither")
    if service is None:
        return WebhookOptions(port, certificates)
    with checking("--admission-service"):
        certificate_secret(service)
    return WebhookOptions(port, certificates, service, webhooks)


def lease_of(given: str | None, namespaces: tuple[str, ...]) -> LeaseKey:
    """The Lease of the managers."""
    from application_manager.cluster.leadership import lease_key

    with checking("--lease"):
        return lease_key(given, namespaces)


def detectors_of(
    image: str | None,
    policy: PullPolicy | None,
    secrets: list[str] | None,
    variables: list[str] | None,
    user: str | None,
    metrics_secret: str | None = None,
) -> PodDefaults | None:
    """The defaults for the pods of detectors; None: run no detectors."""
    from application_manager.core.objects.poddefaults import USER, PodDefaults, parse_environment, parse_user

    with checking("--detector-env"):
        environment = parse_environment(variables or ())
    with checking("--detector-user"):
        number = USER if user is None else parse_user(user)
    if image:
        return PodDefaults(image, policy, tuple(secrets or ()), environment, number, metrics_secret)
    if policy or secrets or environment or user or metrics_secret:
        commandline.refuse(
            "options for detectors' pods have no effect without --detector-image: set it, or remove them"
        )
    return None
