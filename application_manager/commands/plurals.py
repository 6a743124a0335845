"""The plurals of kinds for roles: a table for the known kinds, else from the cluster."""

from __future__ import annotations

import asyncio

from application_manager.cluster.client import manager_client
from application_manager.core.objects.policy import PLURALS, KindKey, Policy, kind_text
from wayside.kubernetes.connection import ConfigurationError, load_configuration
from wayside.kubernetes.errors import RequestError


def plurals(policy: Policy) -> dict[KindKey, str]:
    """The plurals of the policy's kinds. Raises ConfigurationError for an unknown kind."""
    known = {kind: PLURALS[kind] for kind in policy.kinds if kind in PLURALS}
    others = sorted(policy.kinds - known.keys())
    return known | (asyncio.run(_looked_up(others)) if others else {})


async def _looked_up(kinds: list[KindKey]) -> dict[KindKey, str]:
    listed = ", ".join(map(kind_text, kinds))
    remedy = "use the kubeconfig of a cluster that has this kind"
    try:
        client = manager_client(await load_configuration())
    except ConfigurationError as error:
        raise ConfigurationError(
            f"cannot look up the plural of {listed} for the roles without a cluster: {error}"
        ) from error
    try:
        found = {}
        for kind in kinds:
            resource = (await client.discover(kind[0])).get(kind)
            if resource is None:
                raise ConfigurationError(
                    f"the cluster has no kind {kind_text(kind)}: {remedy}, or correct --allowed-kinds"
                )
            if not resource.namespaced:
                raise ConfigurationError(
                    f"--allowed-kinds: {kind_text(kind)} is not namespaced and can never be allowed: remove it"
                )
            found[kind] = resource.plural
        return found
    except RequestError as error:
        raise ConfigurationError(
            f"cannot look up the plural of {listed} for the roles in the cluster: {error}: {remedy}"
        ) from error
    finally:
        await client.close()
