"""`application-manager rbac`: the roles that the manager's account needs, as YAML to be applied."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Sequence

import typer
from pydantic import TypeAdapter, ValidationError

from application_manager.cluster.client import manager_client
from application_manager.cluster.leadership import LEASE_NAME, lease_key
from application_manager.core.findings.webhooks import certificate_secret
from application_manager.core.objects.detectors import detector_roles, sidecar_roles
from application_manager.core.objects.policy import PLURALS, KindKey, Policy, kind_text
from application_manager.core.objects.rights import roles
from wayside.api.base import ObjectName
from wayside.kubernetes.connection import ConfigurationError, load_configuration
from wayside.kubernetes.errors import RequestError
from wayside.manifests import to_yaml


def print_rbac(
    allowed_kinds: list[str] | None,
    namespaces: Sequence[str],
    account: str,
    lease: str | None,
    name: str,
    *,
    detectors: bool,
    grant: Sequence[str],
    service: str | None,
    webhooks: str,
) -> None:
    """Print the roles and bindings as YAML.

    Args:
        allowed_kinds: that templates may create; None: the default ones.
        namespaces: that get a Role each; empty: one ClusterRole that reads all of them.
        account: as NAMESPACE/NAME.
        lease: of the managers, as [NAMESPACE/]NAME; None: the default one, in the account's namespace.
        name: of the roles and bindings.
        detectors: whether the manager runs detectors too.
        grant: without `namespaces`: those in which the manager may write.
        service: of the webhook, as NAMESPACE/NAME, where the manager makes its certificate.
        webhooks: the name of the webhook configurations.

    Raises:
        ConfigurationError: a kind has to be looked up and cannot be.
    """
    where, _, who = account.partition("/")
    if not where or not who:
        raise typer.BadParameter(f"{account!r} is not a service account: write NAMESPACE/NAME", param_hint="--account")
    if grant and namespaces:
        raise typer.BadParameter("remove it, or --namespace, whose Roles already permit writing", param_hint="--grant")
    try:
        policy = Policy.parse(allowed_kinds, None)
        if not namespaces:
            policy.check_everywhere()
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--allowed-kinds") from None
    try:
        key = lease_key(lease if lease and "/" in lease else f"{where}/{lease or LEASE_NAME}", ())
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--lease") from None
    found = plurals(policy)
    lease_place = (key.namespace, key.name)
    made = roles(
        found,
        namespaces,
        lease_place,
        (where, who),
        name,
        detectors=detectors,
        granted=grant,
        certificates=(certificate_secret(service), webhooks) if service else None,
    )
    sys.stdout.write(to_yaml(made))


def print_detector_rbac(name: str, namespace: str, pod_accounts: Sequence[str]) -> None:
    """Print the account of a Detector and its rights as YAML; those of the accounts of pods, where there are any."""
    _named(name, "Detector", "NAME")
    for account in pod_accounts:
        _named(account, "service account", "--pod-account")
    made = sidecar_roles(namespace, name, pod_accounts) if pod_accounts else detector_roles(namespace, name)
    sys.stdout.write(to_yaml(made))


def _named(name: str, what: str, option: str) -> None:
    """Refuse what is no name."""
    try:
        TypeAdapter(ObjectName).validate_python(name)
    except ValidationError:
        raise typer.BadParameter(
            f"{name!r} is not a {what} name: use at most 63 lower-case letters, digits and -", param_hint=option
        ) from None


def plurals(policy: Policy) -> dict[KindKey, str]:
    """What roles call the kinds of the policy. Raises ConfigurationError for one that nobody knows."""
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
            f"cannot look up the plural of {listed}, which roles need, without a cluster: {error}"
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
                raise ConfigurationError(f"{kind_text(kind)} is not namespaced and can never be allowed")
            found[kind] = resource.plural
        return found
    except RequestError as error:
        raise ConfigurationError(
            f"cannot look up the plural of {listed}, which roles need, in the cluster: {error}: {remedy}"
        ) from error
    finally:
        await client.close()
