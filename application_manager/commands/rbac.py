"""`application-manager rbac`: the roles that the manager's account needs, as YAML to be applied."""

from __future__ import annotations

import asyncio
import sys
from typing import Annotated

import typer
from pydantic import TypeAdapter, ValidationError

from application_manager.cluster.client import ApiError, Client, Unreachable
from application_manager.cluster.connection import ConfigurationError, load_configuration
from application_manager.cluster.leadership import LEASE_NAME, lease_key
from application_manager.core.objects.detectors import detector_roles, sidecar_roles
from application_manager.core.objects.policy import DEFAULT_PLURALS, KindKey, Policy, kind_text
from application_manager.core.objects.rights import roles
from wayside.api.base import ObjectName
from wayside.manifests import to_yaml


def rbac(
    allowed_kinds: Annotated[
        list[str] | None,
        typer.Option(help="As of `run`: a kind that templates may create; repeatable. Replaces the default."),
    ] = None,
    namespace: Annotated[
        list[str] | None,
        typer.Option(
            help="As of `run`: a namespace to look after, which gets a Role; repeatable. Default: a ClusterRole."
        ),
    ] = None,
    account: Annotated[
        str, typer.Option(metavar="NAMESPACE/NAME", help="The service account that the manager runs with.")
    ] = "wayside/application-manager",
    lease: Annotated[
        str | None, typer.Option(metavar="[NAMESPACE/]NAME", help="As of `run`. Default: in the account's namespace.")
    ] = None,
    detectors: Annotated[
        bool, typer.Option("--detectors", help="For a manager with --detector-image, which runs detectors too.")
    ] = False,
    name: Annotated[
        str, typer.Option(help="Of the roles and bindings; managers of different namespaces need different ones.")
    ] = "wayside-application-manager",
) -> None:
    """Print the roles that the manager's account needs for the kinds that templates may create, and no more.

    Only a kind that is not one of the default ones is looked up in the cluster of the current kubeconfig.
    """
    where, _, who = account.partition("/")
    if not where or not who:
        raise typer.BadParameter(f"{account!r} is no account: write NAMESPACE/NAME", param_hint="--account")
    try:
        policy = Policy.parse(allowed_kinds, None)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--allowed-kinds") from None
    try:
        key = lease_key(lease if lease and "/" in lease else f"{where}/{lease or LEASE_NAME}", ())
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--lease") from None
    found = plurals(policy)
    lease_place = (key.namespace, key.name)
    sys.stdout.write(to_yaml(roles(found, namespace or (), lease_place, (where, who), name, detectors=detectors)))


def detector_rbac(
    name: Annotated[str, typer.Argument(help="The Detector.")],
    namespace: Annotated[str, typer.Option("--namespace", "-n", help="Its namespace.")],
    pod_account: Annotated[
        list[str] | None,
        typer.Option(help="An account of pods that have the detector as a sidecar; repeatable. No other is made."),
    ] = None,
) -> None:
    """Print the account of a detector that you run yourself, with the rights that it needs, and no more."""
    _named(name, "Detector", "NAME")
    for account in pod_account or ():
        _named(account, "account", "--pod-account")
    made = sidecar_roles(namespace, name, pod_account) if pod_account else detector_roles(namespace, name)
    sys.stdout.write(to_yaml(made))


def _named(name: str, what: str, option: str) -> None:
    """Refuse what is no name."""
    try:
        TypeAdapter(ObjectName).validate_python(name)
    except ValidationError:
        raise typer.BadParameter(
            f"{name!r} is no {what}'s name: small letters, digits and -, at most 63", param_hint=option
        ) from None


def plurals(policy: Policy) -> dict[KindKey, str]:
    """What roles call the kinds of the policy. Raises ConfigurationError for one that nobody knows."""
    known = {kind: DEFAULT_PLURALS[kind] for kind in policy.kinds if kind in DEFAULT_PLURALS}
    others = sorted(policy.kinds - known.keys())
    return known | (asyncio.run(_asked(others)) if others else {})


async def _asked(kinds: list[KindKey]) -> dict[KindKey, str]:
    listed = ", ".join(map(kind_text, kinds))
    remedy = "run this with the kubeconfig of a cluster that has it"
    try:
        client = Client(await load_configuration())
    except ConfigurationError as error:
        raise ConfigurationError(f"what roles call {listed} only a cluster knows: {error}") from error
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
    except (ApiError, Unreachable) as error:
        raise ConfigurationError(f"the cluster does not say what roles call {listed}: {error}: {remedy}") from error
    finally:
        await client.close()
