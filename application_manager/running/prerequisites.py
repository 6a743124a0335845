"""The checks before the manager starts: the kinds that it needs, and its permissions."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from functools import partial

from application_manager.cache.cluster_cache import OWN, POD, TASKS
from application_manager.cluster.leadership import LeaseKey
from application_manager.cluster.permissions import missing_rights, report_missing
from application_manager.core.objects.policy import KindKey, Policy, kind_text
from application_manager.core.objects.rights import lease_rights, read_only, rights
from wayside.kubernetes.client import Client
from wayside.kubernetes.connection import ConfigurationError
from wayside.kubernetes.errors import ApiError
from wayside.kubernetes.resources import Resource
from wayside.kubernetes.retrying import until_answered

log = logging.getLogger(__name__)


OLDEST = (1, 31)
"""The oldest supported Kubernetes: 1.30 ignores `selectableFields` of CRDs, by which an instance's tasks are listed."""


async def check_version(client: Client) -> str:
    """Returns the API server's version. Raises ConfigurationError if it is older than `OLDEST`."""
    version = await until_answered(client.server_version)
    found = re.match(r"v?(\d+)\.(\d+)", version)
    if found is not None and (int(found[1]), int(found[2])) < OLDEST:
        raise ConfigurationError(
            f"the API server is Kubernetes {version}, but {'.'.join(map(str, OLDEST))} or newer is required: older "
            "versions ignore selectableFields of custom resources, so applications would never be released; "
            "upgrade the cluster"
        )
    return version


async def check_selectable_fields(client: Client, namespaces: tuple[str, ...]) -> None:
    """Check that tasks can be listed by their template: CRDs of an older release, or a proxy, may not support it.

    Raises ConfigurationError if they cannot.
    """
    namespace = next(iter(sorted(namespaces)), None)
    try:
        await until_answered(partial(client.list, TASKS, namespace, fields="spec.templateName=none"))
    except ApiError as error:
        if error.code != 400:
            raise
        raise ConfigurationError(
            f"cannot select ApplicationTasks by spec.templateName ({error.message}), so applications would never be "
            "released: run kubectl apply -f crds/ on Kubernetes 1.31 or newer"
        ) from None


async def discover_resources(client: Client, policy: Policy) -> dict[KindKey, Resource]:
    """The resources of our own kinds and those of the policy; a kind that the cluster lacks is omitted and logged.

    Raises ConfigurationError if one of our own kinds is missing, or an allowed one is not namespaced.
    """
    found: dict[KindKey, Resource] = {}
    for version in sorted({each[0] for each in (*OWN, POD, *policy.kinds)}):
        found |= await until_answered(partial(client.discover, version))
    missing = [kind_text(kind) for kind in OWN if kind not in found]
    if missing:
        raise ConfigurationError(f"the cluster has no kind {', '.join(missing)}: run kubectl apply -f crds/")
    for kind in sorted(policy.kinds):
        if kind not in found:
            log.warning("the cluster has no kind %s: templates that use it are refused", kind_text(kind))
        elif not found[kind].namespaced:
            raise ConfigurationError(
                f"--allowed-kinds: {kind_text(kind)} is not namespaced and can never be allowed: remove it"
            )
    return found


async def check_rights(
    client: Client,
    policy: Policy,
    resources: Mapping[KindKey, Resource],
    namespaces: tuple[str, ...],
    lease: LeaseKey,
    *,
    detectors: bool = False,
) -> None:
    """Check that the account has the permissions that it needs, and report the missing ones.

    For all namespaces, only reading is checked: writing is checked per namespace when it is needed. `detectors`:
    whether the manager runs detectors. Raises ConfigurationError if the manager cannot work without a missing one.
    """
    plurals = {kind: resources[kind].plural for kind in policy.kinds if kind in resources}
    needed_there = rights(plurals, detectors=detectors)
    for needed, where in (
        (needed_there if namespaces else read_only(needed_there), namespaces),
        (lease_rights(lease.name), (lease.namespace,)),
    ):
        report_missing(await until_answered(partial(missing_rights, client, needed, where)))
