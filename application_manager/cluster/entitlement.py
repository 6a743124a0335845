"""Checks at the start whether the manager's account has each right that it needs."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Collection, Iterable

from application_manager.core.objects.rights import REMEDY, Right
from wayside.kubernetes.client import Client
from wayside.kubernetes.connection import ConfigurationError
from wayside.kubernetes.resources import Resource

_REVIEWS = Resource("authorization.k8s.io/v1", "SelfSubjectAccessReview", "selfsubjectaccessreviews", namespaced=False)
_SHOWN = 10  # of rights that lack, in one message

log = logging.getLogger(__name__)

Lack = tuple[Right, str, str | None]
"""A right, the verb of it that is not allowed, and the namespace; None: all namespaces together."""


async def missing_rights(client: Client, needed: Iterable[Right], namespaces: Collection[str]) -> list[Lack]:
    """What of the rights the account has not, in the namespaces; none given: in all of them together.

    Raises ApiError or Unreachable where the API server does not answer.
    """
    verbs = [(right, verb, where) for where in namespaces or (None,) for right in needed for verb in right.verbs]
    allowed = await asyncio.gather(*(may(client, *each) for each in verbs))
    return [each for each, may in zip(verbs, allowed, strict=True) if not may]


def report_missing(lacks: Collection[Lack]) -> None:
    """Report the missing rights, each with what does not work without it and with the remedy.

    Raises ConfigurationError where nothing works without it.
    """
    if any(right.vital for right, _, _ in lacks):
        shown = [_text(each) for each in sorted(lacks, key=lambda each: not each[0].vital)[:_SHOWN]]
        more = f"; and {len(lacks) - _SHOWN} more" if len(lacks) > _SHOWN else ""
        raise ConfigurationError(f"{'; '.join(shown)}{more}: {REMEDY}")
    for each in lacks:
        log.error("%s: %s", _text(each), REMEDY)


def _text(lack: Lack) -> str:
    right, verb, namespace = lack
    return right.lack(verb, f"in namespace {namespace}" if namespace else "in all namespaces")


async def may(client: Client, right: Right, verb: str, namespace: str | None) -> bool:
    """Whether the account has this verb of the right; `namespace` None: in all namespaces together."""
    resource, _, subresource = right.resource.partition("/")
    attributes = {
        "group": right.group,
        "resource": resource,
        "subresource": subresource,
        "verb": verb,
        "name": right.name,
        "namespace": namespace or "",
    }
    answer = await client.review(
        _REVIEWS,
        {
            "apiVersion": _REVIEWS.api_version,
            "kind": _REVIEWS.kind,
            "spec": {"resourceAttributes": {key: value for key, value in attributes.items() if value}},
        },
    )
    return bool(answer["status"]["allowed"])
