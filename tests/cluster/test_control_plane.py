"""The control plane of these tests does what tests rely on."""

from __future__ import annotations

import pytest

from tests.cluster.api import Api, ApiError, Object, Unreachable
from tests.cluster.controlplane import ControlPlane
from tests.cluster.pods import mark_pods_ready
from tests.cluster.waiting import wait_until


def deployment(name: str, replicas: int = 2) -> Object:
    labels = {"app": name}
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {"name": name},
        "spec": {
            "replicas": replicas,
            "selector": {"matchLabels": labels},
            "template": {
                "metadata": {"labels": labels},
                "spec": {"containers": [{"name": "app", "image": "registry.invalid/app:1"}]},
            },
        },
    }


def configmap(name: str, owner: Object | None = None) -> Object:
    metadata: Object = {"name": name}
    if owner is not None:
        reference = {key: owner[key] for key in ("apiVersion", "kind")}
        reference |= {key: owner["metadata"][key] for key in ("name", "uid")}
        metadata["ownerReferences"] = [reference | {"controller": True}]
    return {"apiVersion": "v1", "kind": "ConfigMap", "metadata": metadata, "data": {"key": "value"}}


def test_a_namespace_has_its_default_service_account_and_root_certificate(api: Api) -> None:
    assert api.get("ServiceAccount", "default")["metadata"]["namespace"] == api.namespace
    certificate = api.wait_for("ConfigMap", "kube-root-ca.crt", lambda _: True, what="the certificate is published")
    assert "BEGIN CERTIFICATE" in certificate["data"]["ca.crt"]


def test_a_deployment_gets_its_replica_set_and_pods(api: Api) -> None:
    created = api.apply(deployment("app", replicas=3))

    pods = api.wait_list("Pod", lambda pods: len(pods) == 3, labels="app=app", what="three pods exist")
    (replica_set,) = api.list("ReplicaSet", labels="app=app")
    assert replica_set["metadata"]["ownerReferences"][0]["uid"] == created["metadata"]["uid"]
    assert {pod["metadata"]["ownerReferences"][0]["uid"] for pod in pods} == {replica_set["metadata"]["uid"]}
    assert {pod["spec"]["serviceAccountName"] for pod in pods} == {"default"}


def test_marked_pods_make_a_deployment_available(api: Api) -> None:
    api.apply(deployment("app"))
    api.apply(deployment("other"))
    api.wait_list("Pod", lambda pods: len(pods) == 4, what="four pods exist")

    assert len(mark_pods_ready(api, "app=app")) == 2

    ready = api.wait_for(
        "Deployment", "app", lambda found: found["status"].get("availableReplicas") == 2, what="app is available"
    )
    conditions = {each["type"]: each["status"] for each in ready["status"]["conditions"]}
    assert conditions["Available"] == "True"
    assert "availableReplicas" not in api.get("Deployment", "other")["status"]


def test_marking_pods_twice_changes_nothing(api: Api) -> None:
    api.apply(deployment("app"))
    api.wait_list("Pod", lambda pods: len(pods) == 2, what="two pods exist")
    mark_pods_ready(api)
    first = api.list("Pod")
    assert mark_pods_ready(api) == []
    assert api.list("Pod") == first


@pytest.mark.usefixtures("kubelet")
def test_with_the_kubelet_fixture_deployments_become_available_by_themselves(api: Api) -> None:
    for name in ("one", "two"):
        api.apply(deployment(name))
    for name in ("one", "two"):
        api.wait_for(
            "Deployment", name, lambda found: found["status"].get("availableReplicas") == 2, what=f"{name} is available"
        )


def test_what_a_deleted_object_owns_goes_too(api: Api) -> None:
    api.apply(deployment("app"))
    api.wait_list("Pod", lambda pods: len(pods) == 2, what="two pods exist")

    api.delete("Deployment", "app")

    api.wait_gone("Deployment", "app")
    api.wait_list("ReplicaSet", lambda found: not found, what="the replica set is collected")
    api.wait_list("Pod", lambda found: not found, what="the pods are collected")


def test_what_an_application_instance_owns_goes_with_it(api: Api) -> None:
    instance = api.create(
        {
            "apiVersion": "wayside.dev/v1alpha1",
            "kind": "ApplicationInstance",
            "metadata": {"name": "owner"},
            "spec": {"template": "recorder"},
        }
    )
    api.create(configmap("owned", instance))
    api.create(configmap("free"))

    api.delete("ApplicationInstance", "owner")

    api.wait_gone("ConfigMap", "owned")
    assert api.find("ConfigMap", "free") is not None


def test_a_deleted_namespace_takes_everything_with_it(api: Api) -> None:
    api.create(configmap("inside"))  # Takes 5 s: the controller waits for admission that lags.
    api.delete("Namespace", api.namespace)
    api.wait_gone("Namespace", api.namespace)


def test_kubectl_works_with_the_kubeconfig(control_plane: ControlPlane, namespace: str) -> None:
    assert control_plane.kubectl("get", "namespace", namespace, "-o", "name") == f"namespace/{namespace}\n"


class TestErrors:
    def test_a_refusal_carries_the_servers_reason_and_words(self, api: Api) -> None:
        api.create(configmap("there"))
        with pytest.raises(ApiError, match=r'configmaps "there" already exists') as caught:
            api.create(configmap("there"))
        assert (caught.value.code, caught.value.reason) == (409, "AlreadyExists")

    def test_a_misspelt_field_is_refused(self, api: Api) -> None:
        with pytest.raises(ApiError, match=r'unknown field "dta"'):
            api.create(configmap("typo") | {"dta": {}})

    def test_an_unknown_kind_is_named(self, api: Api) -> None:
        with pytest.raises(LookupError, match="no kind 'Deploymnt'"):
            api.list("Deploymnt")

    def test_a_wait_that_fails_shows_the_last_state(self, api: Api) -> None:
        api.create(configmap("there"))
        with pytest.raises(TimeoutError, match=r'(?s)still not: it is green\. Last seen:.*"key": "value"'):
            api.wait_for("ConfigMap", "there", lambda _: False, timeout=0.1, what="it is green")

    def test_an_unknown_token_is_refused(self, control_plane: ControlPlane) -> None:
        nobody = Api(control_plane.kubeconfig_with_token("nobody", "not-a-token"))
        with pytest.raises(ApiError) as caught:
            nobody.list("ConfigMap")
        assert caught.value.code == 401


class TestRoleBasedAccess:
    def test_a_service_account_may_do_only_what_a_role_allows(self, control_plane: ControlPlane, api: Api) -> None:
        account = Api(control_plane.kubeconfig_of_service_account(api.namespace, "default"), api.namespace)
        with pytest.raises(ApiError) as caught:
            account.list("ConfigMap")
        assert caught.value.code == 403

        name = {"name": "reader"}
        rules = [{"apiGroups": [""], "resources": ["configmaps"], "verbs": ["list"]}]
        api.create({"apiVersion": "rbac.authorization.k8s.io/v1", "kind": "Role", "metadata": name, "rules": rules})
        api.create(
            {
                "apiVersion": "rbac.authorization.k8s.io/v1",
                "kind": "RoleBinding",
                "metadata": name,
                "roleRef": {"apiGroup": "rbac.authorization.k8s.io", "kind": "Role", "name": "reader"},
                "subjects": [{"kind": "ServiceAccount", "name": "default", "namespace": api.namespace}],
            }
        )

        # The authorizer learns of the role by a watch, a moment later.
        wait_until(lambda: account.list("ConfigMap"), lambda _: True, transient=(ApiError,), what="it may list")
        with pytest.raises(ApiError, match="cannot create resource"):
            account.create(configmap("forbidden"))


class TestOutage:
    @pytest.mark.own_control_plane
    def test_the_data_outlives_the_api_server(self, control_plane: ControlPlane, api: Api) -> None:
        before = api.create(configmap("there"))
        with control_plane.outage(), pytest.raises(Unreachable):
            api.get("ConfigMap", "there")
        assert api.get("ConfigMap", "there") == before

    @pytest.mark.own_control_plane
    def test_the_controllers_go_on_soon_after_it(self, control_plane: ControlPlane, api: Api) -> None:
        before = control_plane.controller_manager
        with control_plane.outage():
            pass
        assert control_plane.controller_manager is not before, "the watches of the old one would back off"
        api.apply(deployment("app"))
        api.wait_list("Pod", lambda pods: len(pods) == 2, what="the controllers make pods again")

    @pytest.mark.own_control_plane
    def test_what_a_failed_test_left_stopped_is_started_for_the_next(
        self, control_plane: ControlPlane, api: Api
    ) -> None:
        control_plane.stop_controller_manager()
        control_plane.stop_api_server()
        control_plane.recover()
        api.apply(deployment("app"))
        api.wait_list("Pod", lambda pods: len(pods) == 2, what="the controllers make pods again")
