"""What there must be before the manager can begin: the kinds that it knows, and the rights that it needs."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import partial

from application_manager.cluster.client import Client, Resource
from application_manager.cluster.connection import ConfigurationError
from application_manager.cluster.entitlement import judge, lacking
from application_manager.cluster.leadership import LeaseKey
from application_manager.cluster.starting import until_answered
from application_manager.core.objects.policy import KindKey, Policy, kind_text
from application_manager.core.objects.rights import lease_rights, rights
from application_manager.knowledge.world import OWN_KINDS, POD

log = logging.getLogger(__name__)


async def discovered(client: Client, policy: Policy) -> dict[KindKey, Resource]:
    """Where our own kinds and those of the policy live; a kind that the cluster lacks is left out, and said.

    Raises ConfigurationError where one of our own lacks, or one that is allowed is not namespaced.
    """
    found: dict[KindKey, Resource] = {}
    for version in sorted({each[0] for each in (*OWN_KINDS, POD, *policy.kinds)}):
        found |= await until_answered(partial(client.discover, version))
    lacking = [kind_text(kind) for kind in OWN_KINDS if kind not in found]
    if lacking:
        raise ConfigurationError(f"the cluster has no kind {', '.join(lacking)}: run kubectl apply -f crds/")
    for kind in sorted(policy.kinds):
        if kind not in found:
            log.warning("the cluster has no kind %s: templates that use it fail", kind_text(kind))
        elif not found[kind].namespaced:
            raise ConfigurationError(f"{kind_text(kind)} is not namespaced and can never be allowed")
    return found


async def entitled(
    client: Client,
    policy: Policy,
    resources: Mapping[KindKey, Resource],
    namespaces: tuple[str, ...],
    lease: LeaseKey,
    *,
    detectors: bool = False,
) -> None:
    """Look whether the account has the rights that it needs, and say what lacks.

    `detectors`: whether the manager runs detectors too. Raises ConfigurationError where nothing works without.
    """
    plurals = {kind: resources[kind].plural for kind in policy.kinds if kind in resources}
    for needed, where in (
        (rights(plurals, detectors=detectors), namespaces),
        (lease_rights(lease.name), (lease.namespace,)),
    ):
        judge(await until_answered(partial(lacking, client, needed, where)))
