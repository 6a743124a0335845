"""Checks the permissions of the manager's account: all at the start, and writing per namespace when it is needed.

By its ClusterRole, the account of a manager of all namespaces may read everywhere. It may write where an administrator
binds it to the role for writing (`application-manager rbac --grant`). The manager ignores the objects in other
namespaces: otherwise it would repeatedly send a request for each of them, and the API server would refuse it.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Collection, Iterable

from application_manager.core.objects.rights import REMEDY, PolicyRule, granting
from wayside.kubernetes.client import Client
from wayside.kubernetes.connection import ConfigurationError
from wayside.kubernetes.resources import Resource
from wayside.kubernetes.retrying import repeatedly

_REVIEWS = Resource("authorization.k8s.io/v1", "SelfSubjectAccessReview", "selfsubjectaccessreviews", namespaced=False)
POLL_EVERY = 5.0  # s between two checks of a namespace in which something is to be written
_SHOWN = 10  # missing permissions in one message

log = logging.getLogger(__name__)

MissingRight = tuple[PolicyRule, str, str | None]
"""A permission, the verb of it that is missing, and the namespace; None: all namespaces."""


async def missing_rights(
    client: Client, needed: Iterable[PolicyRule], namespaces: Collection[str]
) -> list[MissingRight]:
    """The missing permissions in the namespaces; if none are given: cluster-wide.

    Raises ApiError or Unreachable if the API server does not respond.
    """
    verbs = [(right, verb, where) for where in namespaces or (None,) for right in needed for verb in right.verbs]
    allowed = await asyncio.gather(*(may(client, *each) for each in verbs))
    return [each for each, may in zip(verbs, allowed, strict=True) if not may]


def report_missing(missing: Collection[MissingRight]) -> None:
    """Report the missing permissions, each with the consequence and the remedy.

    Raises ConfigurationError if the manager cannot work without one of them.
    """
    if any(right.vital for right, _, _ in missing):
        shown = [_text(each) for each in sorted(missing, key=lambda each: not each[0].vital)[:_SHOWN]]
        more = f"; and {len(missing) - _SHOWN} more" if len(missing) > _SHOWN else ""
        raise ConfigurationError(f"{'; '.join(shown)}{more}: {REMEDY}")
    for each in missing:
        log.error("%s: %s", _text(each), REMEDY)


def _text(missing: MissingRight) -> str:
    right, verb, namespace = missing
    return right.missing_message(verb, f"in namespace {namespace}" if namespace else "in all namespaces")


async def may(client: Client, right: PolicyRule, verb: str, namespace: str | None) -> bool:
    """Whether the account has this verb of the permission; `namespace` None: in all namespaces."""
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


class NamespacePermissions:
    """Queries the API server once for each namespace, and again while the permission is missing."""

    def __init__(self, client: Client, changed: Callable[[], None]) -> None:
        """`changed` is called when the account is granted the permission to write in a namespace."""
        self._client = client
        self._changed = changed
        self._granted: set[str] = set()
        self._refused: set[str] = set()
        self._querying = asyncio.Lock()

    async def may_write(self, namespace: str) -> bool:
        """Whether the account may write in the namespace. Raises ApiError, or Unreachable if there is no response."""
        async with self._querying:
            if namespace not in self._granted | self._refused:
                granted = await self._is_granted(namespace)
                (self._granted if granted else self._refused).add(namespace)
                if granted:
                    return True
                log.warning(
                    "ignoring namespace %s, which is not granted to this manager: apply the output of "
                    "`application-manager rbac --grant %s`, or add the namespace to manager.grant of the chart",
                    namespace,
                    namespace,
                )
        return namespace in self._granted

    async def run(self) -> None:
        """Check the namespaces without permission periodically, until cancelled."""
        await repeatedly(self._refresh, POLL_EVERY, "")  # the health check reports that the API server does not respond

    async def _refresh(self) -> None:
        granted = [each for each in sorted(self._refused) if await self._is_granted(each)]
        if granted:
            log.info("namespace %s is granted to this manager", ", ".join(granted))
            self._refused.difference_update(granted)
            self._granted.update(granted)
            self._changed()

    async def _is_granted(self, namespace: str) -> bool:
        right = granting()
        return await may(self._client, right, right.verbs[0], namespace)
