"""The manager needs exactly the rights that `application-manager rbac` prints, and reports a missing one."""

from __future__ import annotations

import asyncio
import copy
import functools
import itertools
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
import yaml

from application_manager.cluster.client import manager_client
from application_manager.cluster.permissions import missing_rights
from application_manager.core.claims.claims import instance_name
from application_manager.core.objects.policy import PLURALS as ALL_PLURALS
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rights import lease_rights, rights, roles
from tests import programs
from tests.cluster.api import Api, ApiError, Object
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import (
    condition,
    config,
    deployment,
    end,
    has_status,
    start_manager,
    task,
    template,
    wait_settled,
)
from tests.cluster.faulty_proxy import ProxiedRequest, faulty_proxy
from tests.cluster.manifests import DETECTOR, EVENT_RULE
from tests.cluster.namespaces import new_namespace
from tests.cluster.processes import Processes
from tests.cluster.waiting import wait_until
from wayside.kubernetes.connection import load_configuration
from wayside.kubernetes.leases import HOLDER_LEASE_LABEL

KINDS = ("apps/v1/Deployment", "v1/ConfigMap")
ALLOWED = [word for each in KINDS for word in ("--allowed-kinds", each)]
PLURALS = {key: ALL_PLURALS[key] for key in Policy.parse(list(KINDS), None).kinds}
NORTH = instance_name("app", "north")

Verb = tuple[str, str, str]
"""Group, resource and verb."""


def printed(*arguments: str) -> list[Object]:
    """The output of the command without a cluster."""
    environment = {"KUBECONFIG": "/nonexistent"}
    done = programs.run("application-manager", "rbac", *arguments, check=True, environment=environment)
    return list(yaml.safe_load_all(done.stdout))


@pytest.fixture
def account(api: Api, namespace: str, control_plane: ControlPlane) -> Path:
    """A kubeconfig for an account without any rights of its own."""
    api.create({"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": "manager"}})
    return control_plane.kubeconfig_of_service_account(namespace, "manager")


def without(manifests: list[Object], group: str, resource: str, verb: str) -> list[Object]:
    """The same roles, all without one verb on one resource."""
    found = copy.deepcopy(manifests)
    for role in found:
        split = []
        for rule in role.get("rules", []):
            if group in rule["apiGroups"] and resource in rule["resources"] and verb in rule["verbs"]:
                rest = [each for each in rule["resources"] if each != resource]
                fewer = [each for each in rule["verbs"] if each != verb]
                split += [rule | {"resources": rest}] if rest else []
                split += [rule | {"resources": [resource], "verbs": fewer}] if fewer else []
            else:
                split.append(rule)
        if "rules" in role:
            role["rules"] = split
    return found


def put(api: Api, manifests: list[Object]) -> None:
    for each in manifests:
        api.apply(each)


def wait_in_force(account: Path, namespace: str, manifests: list[Object]) -> None:
    """Wait until the account has all rights of the roles: the API server's watches report the roles a moment later."""
    client = Api(account, namespace)

    def lacks() -> list[Verb]:
        return [
            verb
            for rule, verb in verbs(manifests)
            for name in rule.get("resourceNames", [""])
            if not may(client, namespace, *verb, name)
        ]

    wait_until(lacks, lambda found: not found, what="the roles are in force")


def may(account: Api, namespace: str, group: str, resource: str, verb: str, name: str) -> bool:
    about = {"group": group, "resource": resource, "verb": verb, "name": name, "namespace": namespace}
    api_version = "authorization.k8s.io/v1"
    kind = "SelfSubjectAccessReview"
    requested = {"apiVersion": api_version, "kind": kind, "metadata": {}, "spec": {"resourceAttributes": about}}
    return bool(account.create(requested)["status"]["allowed"])


def each_verb_is_missed(api: Api, whole: list[Object], lacks: Callable[[], list[Verb]]) -> None:
    """Remove each verb in turn, from every resource at once; `lacks` must find the removed verbs and no others."""
    by_resource = [sorted(each) for _, each in itertools.groupby(sorted(granted(whole)), key=lambda verb: verb[:2])]
    for removed in itertools.zip_longest(*by_resource):
        expected = sorted(filter(None, removed))
        put(api, functools.reduce(lambda manifests, verb: without(manifests, *verb), expected, whole))
        wait_until(lacks, expected.__eq__, what=f"exactly {expected} are missing")


def used(seen: list[ProxiedRequest], namespace: str) -> Iterator[Verb]:
    """The rights that a manager's requests needed, in RBAC's terms."""
    for each in seen:
        parts = urlsplit(each.path)
        found = re.fullmatch(
            rf"/apis?/(?:(.+)/)?v\w+/namespaces/{namespace}/([^/]+)(?:/([^/]+)(?:/([^/]+))?)?", parts.path
        )
        if found is None:
            continue
        group, resource, name, subresource = found[1] or "", found[2], found[3], found[4]
        looking = "watch" if "watch=true" in parts.query else "get" if name else "list"
        verb = {"GET": looking, "POST": "create", "PUT": "update", "PATCH": "patch", "DELETE": "delete"}[each.method]
        yield group, f"{resource}/{subresource}" if subresource else resource, verb


def granted(manifests: list[Object]) -> set[Verb]:
    return {verb for _, verb in verbs(manifests)}


def verbs(manifests: list[Object]) -> Iterator[tuple[Object, Verb]]:
    """All verbs of the roles, each with its rule."""
    for role in manifests:
        for rule in role.get("rules", []):
            for each in itertools.product(rule["apiGroups"], rule["resources"], rule["verbs"]):
                yield rule, each


def test_a_life_cycle_needs_exactly_the_printed_rights(
    api: Api, processes: Processes, namespace: str, account: Path, kubelet: None
) -> None:
    manifests = printed("--namespace", namespace, "--account", f"{namespace}/manager", *ALLOWED)
    put(api, manifests)
    wait_in_force(account, namespace, manifests)
    with faulty_proxy(account) as (proxy, kubeconfig):
        manager = start_manager(
            processes, namespace, *ALLOWED, "--ttl-after-finished", "2s", "--resync", "2s", kubeconfig=kubeconfig
        )
        api.create(
            template(
                linger="1s",
                configuration={"app.json": {"x": "${parameters.region}"}},
                manifests=[mounted(), config({"a": "b"}), deployment(name="${instance.name}-extra")],
            )
        )
        api.create(task("held", region="north", holder="town"))
        api.create(task("north"))
        api.create(task("wrong", of="nowhere"))
        api.wait_for("Deployment", NORTH, lambda raw: raw.get("status", {}).get("readyReplicas") == 1, what="it runs")
        wait_settled(api)
        pods = api.list("Pod")
        assert pods
        stop = task("stop", region="north")
        api.create(stop | {"spec": stop["spec"] | {"operation": "Suspend"}})
        api.wait_for("Deployment", NORTH, lambda raw: raw["spec"]["replicas"] == 0, what="it is suspended")
        end(api, "stop")
        api.wait_for("Deployment", NORTH, lambda raw: raw["spec"]["replicas"] == 1, what="it is resumed")
        for value, status in (("anna", "True"), (None, "False"), ("anna", "True")):  # repeated Events become a series
            api.patch("ApplicationInstance", NORTH, {"metadata": {"annotations": {"wayside.dev/pause": value}}})
            api.wait_for(
                "ApplicationInstance",
                NORTH,
                lambda raw, status=status: condition(raw, "Paused").get("status") == status,  # type: ignore[misc]
                what="it is paused, or not",
            )
        api.patch("ApplicationInstance", NORTH, {"metadata": {"annotations": {"wayside.dev/pause": None}}})
        api.patch("ApplicationTemplate", "app", {"spec": {"configuration": {"app.json": {"x": "new"}}}})
        wait_until(
            lambda: [each["metadata"].get("annotations", {}) for each in api.list("Pod")],
            lambda found: any("wayside.dev/configuration" in each for each in found),
            what="a pod has its configuration",
        )
        api.patch("ApplicationTemplate", "app", {"spec": {"manifests": [mounted()]}})
        api.wait_gone("ConfigMap", f"{NORTH}-config")
        api.wait_gone("Deployment", f"{NORTH}-extra")
        for each in (DETECTOR, EVENT_RULE):
            api.create(each)
            judged = each["metadata"]["name"]
            api.wait_for(each["kind"], judged, has_status, what=f"{judged} is judged")
        for name in ("held", "north", "wrong"):
            end(api, name)
        api.wait_gone("Deployment", NORTH)
        api.wait_list("ApplicationTask", lambda found: not found, what="finished tasks are deleted")
        wait_until(
            lambda: set(used(proxy.seen, namespace)),
            lambda found: {("events.k8s.io", "events", each) for each in ("create", "patch")} <= found,
            what="Events are posted",
        )
        assert manager.terminate() == 0
    assert "orbidden" not in manager.output()
    assert "service account cannot" not in manager.output()
    watches = [each.path for each in proxy.seen if "/leases?" in each.path and "watch=true" in each.path]
    assert watches
    assert {tuple(parse_qs(urlsplit(each).query)["labelSelector"]) for each in watches} == {(HOLDER_LEASE_LABEL,)}
    requested = set(used(proxy.seen, namespace))
    for group, resource, verb in [*requested]:
        if verb == "patch" and resource in ("applicationinstances", "deployments", "configmaps"):
            requested.add((group, resource, "create"))  # an apply that creates an object needs both
    never = {("coordination.k8s.io", "leases", "get")} if "/leases/wayside-" not in str(proxy.seen) else set()
    instance_after_a_failure = {("wayside.dev", "applicationinstances", "get")}
    assert granted(manifests) - requested - never <= instance_after_a_failure
    assert requested <= granted(manifests)


@pytest.mark.own_control_plane
def test_a_manager_of_all_namespaces_writes_only_in_granted_ones(
    api: Api, processes: Processes, namespace: str, account: Path, control_plane: ControlPlane
) -> None:
    other = control_plane.api(new_namespace(control_plane.api(), "other"))
    options = ("--account", f"{namespace}/manager", "--name", namespace, "--detectors", *ALLOWED)
    put(api, manifests := printed(*options, "--grant", namespace))
    try:
        wait_in_force(account, namespace, [each for each in manifests if each["kind"] != "ClusterRoleBinding"])
        lease = ["--lease", f"{namespace}/application-manager", "--detector-image", "wayside:1"]
        with faulty_proxy(account) as (proxy, kubeconfig):
            manager = start_manager(processes, None, *ALLOWED, *lease, kubeconfig=kubeconfig)
            manager.wait_for_output("active: holds the Lease")
            for each in (other, api):
                each.create(template())
                each.create(task("north"))
            api.create(DETECTOR | {"spec": DETECTOR["spec"] | {"mode": "Standalone"}})
            api.wait_for("Deployment", NORTH, lambda _: True, what="it is served")
            name = f"detector-{DETECTOR['metadata']['name']}"
            api.wait_for("Deployment", name, lambda _: True, what="the detector has its rights and its pod")
            wait_settled(api)
            manager.wait_for_output(f"ignoring namespace {other.namespace}, which is not granted to this manager")
            assert not list(used(proxy.seen, other.namespace)), "it neither reads nor writes there"
            assert other.find("ApplicationInstance", NORTH) is None

            what_it_cannot_do(Api(account, namespace), Api(account, other.namespace), api.get("Role", name))

            put(api, printed(*options, "--grant", namespace, "--grant", other.namespace))
            other.wait_for("Deployment", NORTH, lambda _: True, what="once it is granted, it is served")
            wait_settled(other)
            assert manager.terminate() == 0
        assert "orbidden" not in manager.output()
    finally:
        for kind in ("ClusterRoleBinding", "ClusterRole"):
            api.delete(kind, namespace)
        api.delete("ClusterRole", f"{namespace}-writer")


def what_it_cannot_do(here: Api, elsewhere: Api, role: Object) -> None:
    """Check that the manager's account cannot do these actions.

    Args:
        here: with the account, for a namespace that is granted.
        elsewhere: for one that is not.
        role: of a detector, as the manager made it.
    """
    for each in (here, elsewhere):
        with pytest.raises(ApiError, match='cannot list resource "secrets"'):
            each.list("Secret")
    rbac = {"apiVersion": role["apiVersion"]}
    more: Object = rbac | {"kind": "Role", "metadata": {"name": "more"}}
    for rule in (
        {"apiGroups": [""], "resources": ["secrets"], "verbs": ["get"]},
        {"apiGroups": [""], "resources": ["pods/exec"], "verbs": ["create"]},
        {"apiGroups": ["wayside.dev"], "resources": ["applicationtemplates"], "verbs": ["create"]},
        {"apiGroups": ["*"], "resources": ["*"], "verbs": ["*"]},
    ):
        with pytest.raises(ApiError, match="attempting to grant RBAC permissions not currently held"):
            here.create(more | {"rules": [rule]})
    subjects = [{"kind": "ServiceAccount", "namespace": here.namespace, "name": "default"}]
    for name in ("cluster-admin", "edit", "view"):
        reference = {"apiGroup": "rbac.authorization.k8s.io", "kind": "ClusterRole", "name": name}
        binding = more | {"kind": "RoleBinding", "roleRef": reference, "subjects": subjects}
        with pytest.raises(ApiError, match="attempting to grant RBAC permissions not currently held"):
            here.create(binding)
        with pytest.raises(ApiError, match='cannot create resource "clusterrolebindings"'):
            here.create(binding | {"kind": "ClusterRoleBinding"})
    here.create(more | {"rules": role["rules"]})  # it can grant a detector's rights only where it may write
    with pytest.raises(ApiError, match='cannot create resource "roles"'):
        elsewhere.create(more | {"rules": role["rules"]})
    lease = {"apiVersion": "coordination.k8s.io/v1", "kind": "Lease", "metadata": {"name": "any"}, "spec": {}}
    with pytest.raises(ApiError, match='cannot create resource "leases"'):
        elsewhere.create(lease)
    for kind in ("Pod", "Lease", "Deployment", "ApplicationTask"):
        with pytest.raises(ApiError, match="cannot patch resource"):
            elsewhere.patch(kind, "any", {"metadata": {"labels": {"a": "b"}}})


def test_each_missing_verb_is_noticed(api: Api, namespace: str, account: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KUBECONFIG", str(account))
    needed = rights(PLURALS)
    whole = roles(PLURALS, [namespace], (namespace, "application-manager"), (namespace, "manager"))

    def lacks() -> list[Verb]:
        async def ask() -> list[Verb]:
            client = manager_client(await load_configuration())
            try:
                found = await missing_rights(client, needed, [namespace])
                found += await missing_rights(client, lease_rights("application-manager"), [namespace])
            finally:
                await client.close()
            return sorted({(right.group, right.resource, verb) for right, verb, _ in found})

        return asyncio.run(ask())

    put(api, whole)
    wait_until(lacks, lambda found: not found, what="nothing lacks")
    each_verb_is_missed(api, whole, lacks)


def test_a_missing_essential_right_ends_the_start_with_one_line(
    api: Api, processes: Processes, namespace: str, account: Path
) -> None:
    whole = printed("--namespace", namespace, "--account", f"{namespace}/manager", *ALLOWED)
    put(api, fewer := without(whole, "wayside.dev", "applicationtasks", "watch"))
    wait_in_force(account, namespace, fewer)
    environment = {"KUBECONFIG": str(account)}
    manager = processes.start("application-manager", "run", "--namespace", namespace, *ALLOWED, environment=environment)
    assert manager.wait() == 2
    logged = f"its service account cannot watch applicationtasks of wayside.dev in namespace {namespace}, so no task is"
    assert logged in manager.output()
    assert "apply the output of `application-manager rbac`" in manager.output()


def test_a_missing_optional_right_is_reported_at_the_start_and_where_it_is_needed(
    api: Api, processes: Processes, namespace: str, account: Path
) -> None:
    whole = printed("--namespace", namespace, "--account", f"{namespace}/manager", *ALLOWED)
    put(api, fewer := without(whole, "", "configmaps", "patch"))
    wait_in_force(account, namespace, fewer)
    manager = start_manager(processes, namespace, *ALLOWED, kubeconfig=account)
    assert f"its service account cannot patch configmaps in namespace {namespace}, so no ConfigMap" in manager.output()
    api.create(template("other"))
    api.create(template(manifests=[deployment(), config({"a": "b"})]))
    api.create(task("north"))
    api.create(task("south", of="other"))
    reported = api.wait_for(
        "ApplicationInstance",
        NORTH,
        lambda raw: condition(raw, "Applied").get("reason") == "ApplyRefused",
        what="the instance reports the missing right",
    )
    message = condition(reported, "Applied")["message"]
    assert 'cannot patch resource "configmaps"' in message
    assert "apply the output of `application-manager rbac`" in message
    api.wait_for("Deployment", instance_name("other", "south"), lambda _: True, what="others are served")
    put(api, whole)
    api.wait_for(
        "ConfigMap", f"{NORTH}-config", lambda _: True, what="the ConfigMap is created once the right is granted"
    )
    wait_settled(api)


def mounted() -> Object:
    """A Deployment that mounts its configuration."""
    made = deployment()
    pod = made["spec"]["template"]["spec"]
    pod["volumes"] = [{"name": "configuration", "configMap": {"name": "${instance.configMap}"}}]
    pod["containers"][0]["volumeMounts"] = [{"name": "configuration", "mountPath": "/configuration"}]
    return made
