"""A detector's account can act only for its own holder: the chart's ValidatingAdmissionPolicy on a real API server."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from application_manager.core.objects.detectors import detector_roles, object_name, sidecar_roles
from tests.cluster.api import Api, ApiError, Object
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import task
from tests.cluster.test_manager_memory import event, with_spec
from tests.cluster.waiting import wait_until
from tests.helm import ensure_tools
from tests.helm.wayside_chart import Helm

DETECTORS = ("town", "harbour")
TASKS = ["get", "list", "watch", "create", "patch", "update", "delete"]
REFUSED = "may not {}.*; a role must allow the verb hold"


@pytest.fixture
def applied(control_plane: ControlPlane, api: Api, tmp_path: Path) -> Iterator[Api]:
    """The accounts of detectors as the manager makes them, and the chart's policy, in the test's namespace."""
    values = {"crds": {"install": False}, "manager": {"namespaces": [api.namespace]}}
    rendered = Helm(ensure_tools().helm, tmp_path / "home").rendered(
        values | {"fullnameOverride": api.namespace[:40].rstrip("-")}, namespace=api.namespace
    )
    policies = rendered.of("ValidatingAdmissionPolicy", "ValidatingAdmissionPolicyBinding")
    for each in (*policies, *(role for name in DETECTORS for role in detector_roles(api.namespace, name))):
        api.apply(each)
    yield api
    for each in policies:
        api.delete(each["kind"], each["metadata"]["name"])


@pytest.fixture
def large(api: Api) -> Object:
    """A task whose parameters are too large in total for the policy: request it before `applied`."""
    texts = {f"p{index}": "x" * 60_000 for index in range(10)}  # each is within the limits of the CRD
    return api.create(with_spec(task("before"), parameters=texts))


Account = Callable[..., Api]


@pytest.fixture
def account(applied: Api, control_plane: ControlPlane) -> Account:
    """A client of the detector's account.

    With `pod`: of an account of that name, by its token that is bound to a pod, bound as the manager binds those that
    the Detector names, unless there are `verbs`; with these, an account that has them.
    """

    def made(detector: str, pod: str = "", verbs: tuple[str, ...] = ()) -> Api:
        name = object_name(detector)
        if verbs:
            name = detector
            grant(applied, name, *verbs)
        elif pod:
            name = detector
            applied.apply({"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": name}})
            for role in sidecar_roles(applied.namespace, detector, [name]):
                applied.apply(role)
        request: Object = {
            "apiVersion": "authentication.k8s.io/v1",
            "kind": "TokenRequest",
            "spec": {"expirationSeconds": 3600},
        }
        if pod:
            spec = {"serviceAccountName": name, "containers": [{"name": "main", "image": "main"}]}
            created = applied.create({"apiVersion": "v1", "kind": "Pod", "metadata": {"name": pod}, "spec": spec})
            bound = {"apiVersion": "v1", "kind": "Pod", "name": pod, "uid": created["metadata"]["uid"]}
            request["spec"]["boundObjectRef"] = bound
        token = applied.post("ServiceAccount", name, "token", request)["status"]["token"]
        return Api(control_plane.kubeconfig_with_token(f"{applied.namespace}-{name}-{pod}", token), applied.namespace)

    return made


def grant(api: Api, name: str, *verbs: str) -> None:
    """An account with rights to tasks and Leases, and these verbs on all Detectors."""
    rbac = "rbac.authorization.k8s.io"
    rules = [
        {"apiGroups": ["wayside.dev"], "resources": ["applicationtasks"], "verbs": TASKS},
        {"apiGroups": ["coordination.k8s.io"], "resources": ["leases"], "verbs": TASKS},
    ]
    if verbs != ("none",):
        rules.append({"apiGroups": ["wayside.dev"], "resources": ["detectors"], "verbs": [*verbs]})
    subject = {"kind": "ServiceAccount", "name": name, "namespace": api.namespace}
    api.apply({"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": name}})
    api.apply({"apiVersion": f"{rbac}/v1", "kind": "Role", "metadata": {"name": name}, "rules": rules})
    binding: dict[str, Any] = {"apiVersion": f"{rbac}/v1", "kind": "RoleBinding", "metadata": {"name": name}}
    api.apply(binding | {"roleRef": {"apiGroup": rbac, "kind": "Role", "name": name}, "subjects": [subject]})


def lease(name: str) -> Object:
    return {"apiVersion": "coordination.k8s.io/v1", "kind": "Lease", "metadata": {"name": name}, "spec": {}}


def held(name: str, holder: str) -> Object:
    return task(name, holder=holder)


def wait_in_force(api: Api, probe: Api) -> None:
    """Wait: the API server enforces policies and roles a moment after they are stored."""

    def refused() -> str:
        try:
            probe.create(held("probe", "nobody"))
        except ApiError as error:
            return error.message
        api.delete("ApplicationTask", "probe")
        return ""

    wait_until(refused, lambda logged: "the verb hold" in logged, what="the policy is in force")


def refuses(what: str, act: Callable[[], object]) -> None:
    with pytest.raises(ApiError, match=REFUSED.format(what)) as caught:
        act()
    assert caught.value.code == 403


def test_a_standalone_detector_may_write_only_its_own_tasks_and_its_own_lease(applied: Api, account: Account) -> None:
    town = account("town")
    wait_in_force(applied, town)
    applied.create(held("of-harbour", "harbour"))
    applied.create(task("by-anna"))  # of a user, which is no service account

    town.create(held("mine", "town"))
    town.patch("ApplicationTask", "mine", [{"op": "add", "path": "/spec/endTime", "value": "2026-01-01T00:00:00Z"}])
    town.delete("ApplicationTask", "mine")
    refuses("create the task other of holder harbour", lambda: town.create(held("other", "harbour")))
    refuses("create the task free: it has no holder", lambda: town.create(task("free")))
    ending = [{"op": "add", "path": "/spec/endTime", "value": "2026-01-01T00:00:00Z"}]
    for name in ("of-harbour", "by-anna"):
        refuses(f"update the task {name}", partial(town.patch, "ApplicationTask", name, ending))
        refuses(f"delete the task {name}", partial(town.delete, "ApplicationTask", name))

    stored = town.create(lease("wayside-town"))
    town.replace(stored)
    refuses("create the Lease wayside-harbour", lambda: town.create(lease("wayside-harbour")))
    refuses("create the Lease application-manager", lambda: town.create(lease("application-manager")))
    town.create(lease("somebody-elses"))  # not a holder's Lease: only roles limit it


def test_a_task_that_is_too_large_in_total_is_rejected_with_its_field_and_an_existing_one_can_end(
    large: Object, applied: Api
) -> None:
    texts = large["spec"]["parameters"]
    lists = {f"x{index}": [f"v{item:05}" for item in range(4000)] for index in range(28)}

    def refused(name: str, **spec: object) -> str:
        try:
            applied.create(with_spec(task(name), **spec))
        except ApiError as error:
            return f"{error.code} {error.message}"
        applied.delete("ApplicationTask", name)
        return ""

    wait_until(lambda: refused("texts", parameters=texts), bool, what="the policy is in force")
    assert re.search(
        r"422 .*: spec\.parameters: Too long: the spec of a task has 600\d{3} characters and may have at most 524288: "
        "shorten the values, or refer to a file",
        refused("texts", parameters=texts),
    )
    assert "spec.event.values: Too long" in refused("lists", event=event(lists))
    within = dict(list(texts.items())[:8])
    assert not refused("within", parameters=within)
    applied.patch("ApplicationTask", "before", {"spec": {"endTime": "2026-01-01T00:00:00Z"}})
    with pytest.raises(ApiError, match=r"spec\.parameters: Too long"):
        applied.patch("ApplicationTask", "before", {"spec": {"parameters": {"p0": "y" * 60_000}}})


def test_a_sidecar_may_act_only_for_the_pod_that_its_token_is_bound_to(applied: Api, account: Account) -> None:
    van = account("van", pod="van-1")
    wait_in_force(applied, van)
    van.create(held("mine", "van.van-1"))
    van.create(lease("wayside-van.van-1"))
    for holder in ("van.van-2", "van", "town.van-1", "town"):
        refuses(f"create the task other of holder {holder}", partial(van.create, held("other", holder)))
    refuses("create the Lease wayside-van.van-2", lambda: van.create(lease("wayside-van.van-2")))
    van.replace(van.get("Lease", "wayside-van.van-1"))
    applied.create(lease("wayside-van.van-2"))
    applied.create(held("of-another", "van.van-2"))
    refuses("update the Lease wayside-van.van-2", lambda: van.replace(applied.get("Lease", "wayside-van.van-2")))
    refuses("delete the task of-another", partial(van.delete, "ApplicationTask", "of-another"))


def test_an_account_with_rights_for_all_detectors_may_write_all_tasks_and_leases(
    applied: Api, account: Account
) -> None:
    probe, robot = account("probe", verbs=("none",)), account("robot", verbs=("hold",))
    wait_in_force(applied, probe)

    def stored() -> bool:
        try:
            robot.create(held("of-harbour", "harbour"))
        except ApiError:
            return False
        return True

    wait_until(stored, bool, what="the roles of the robot are in force, and it creates a task of another holder")
    robot.create(task("free"))
    robot.delete("ApplicationTask", "free")
    refuses("delete the task of-harbour", lambda: probe.delete("ApplicationTask", "of-harbour"))


def test_the_namespace_controller_may_delete_all_objects(applied: Api, account: Account) -> None:
    wait_in_force(applied, account("town"))
    applied.create(held("of-harbour", "harbour"))
    applied.create(lease("wayside-harbour"))
    applied.delete("Namespace", applied.namespace)
    applied.wait_gone("Namespace", applied.namespace)
