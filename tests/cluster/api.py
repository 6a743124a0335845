"""A synchronous client of the API server for tests, with plain JSON objects.

The transport is that of the `kubernetes` package, which the product uses too (there asynchronously). Kinds are named as
in manifests (`"Deployment"`, or `"Event.events.k8s.io"` where two groups have a kind of the same name), and their paths
come from discovery, so CRDs need nothing more.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast
from urllib.parse import urlencode

import urllib3
from kubernetes.client import ApiClient, Configuration
from kubernetes.config import load_kube_config

from tests.cluster.waiting import INTERVAL, wait_until
from tests.patience import PATIENCE

Object = dict[str, Any]  # a Kubernetes object, as JSON
Objects = list[Object]
FIELD_MANAGER = "test"

COME_BACK = frozenset({429, 503})
"""A retriable rejection: a fresh API server answers so until it has read a kind's objects from storage."""

MERGE_PATCH = "application/merge-patch+json"
JSON_PATCH = "application/json-patch+json"
APPLY_PATCH = "application/apply-patch+yaml"
DISCOVERY = "application/json;g=apidiscovery.k8s.io;v=v2;as=APIGroupDiscoveryList"


class ApiError(Exception):
    """The API server rejected the request; the text is its message.

    Attributes:
        code: the HTTP status, e.g. 409.
        reason: the reason of the Status, e.g. `AlreadyExists`.
        message: the message for users.
    """

    def __init__(self, code: int, reason: str, message: str):
        super().__init__(f"{code} {reason}: {message}")
        self.code = code
        self.reason = reason
        self.message = message


class Unreachable(Exception):  # noqa: N818  a state that tests cause deliberately
    """No answer: the API server is unreachable."""


@dataclass(frozen=True)
class Resource:
    """The API path of a kind."""

    api_version: str
    plural: str
    namespaced: bool

    def path(self, namespace: str) -> str:
        """Return the path of the collection."""
        root = f"/apis/{self.api_version}" if "/" in self.api_version else f"/api/{self.api_version}"
        return f"{root}/namespaces/{namespace}/{self.plural}" if self.namespaced else f"{root}/{self.plural}"


class Api:
    """A client for the user of a kubeconfig.

    Every verb works in `namespace` unless another is given or the manifest names one.

    Raises (every verb):
        ApiError: the API server refused.
        Unreachable: it did not answer.
    """

    def __init__(self, kubeconfig: Path, namespace: str = "default"):
        configuration = Configuration()
        load_kube_config(config_file=str(kubeconfig), client_configuration=configuration)  # type: ignore[no-untyped-call]
        configuration.retries = False  # a test that stops the API server expects the error
        self._client = ApiClient(configuration)
        self._authorization = configuration.get_api_key_with_prefix("BearerToken") or ""
        self._resources: dict[str, Resource] = {}
        self.kubeconfig = kubeconfig
        self.namespace = namespace

    def within(self, namespace: str) -> Api:
        """Return a client of the same user for another namespace."""
        return Api(self.kubeconfig, namespace)

    def get(self, kind: str, name: str, *, namespace: str = "", subresource: str = "") -> Object:
        """Return the object; ApiError with code 404 if there is none."""
        return self._object("GET", self._path(kind, namespace, name, subresource))

    def find(self, kind: str, name: str, *, namespace: str = "") -> Object | None:
        """Return the object, or None if there is none."""
        try:
            return self.get(kind, name, namespace=namespace)
        except ApiError as error:
            if error.code == 404:
                return None
            raise

    def list(self, kind: str, *, labels: str = "", fields: str = "", namespace: str = "") -> Objects:
        """Return the objects that match the label and field selectors, in the order of their names."""
        selectors = {"labelSelector": labels, "fieldSelector": fields}
        query = {key: value for key, value in selectors.items() if value}
        found = self._object("GET", self._path(kind, namespace), query)
        shape = {"apiVersion": found["apiVersion"], "kind": found["kind"].removesuffix("List")}
        return [shape | item for item in found["items"]]

    def create(self, manifest: Object) -> Object:
        """Create the object and return it as stored."""
        path = self._path(_kind(manifest), _namespace(manifest))
        return self._object("POST", path, {"fieldManager": FIELD_MANAGER, "fieldValidation": "Strict"}, manifest)

    def apply(
        self, manifest: Object, *, field_manager: str = FIELD_MANAGER, subresource: str = "", dry_run: bool = False
    ) -> Object:
        """Apply the manifest on the server, forced, and return the object as stored, or as it would be."""
        path = self._path(_kind(manifest), _namespace(manifest), manifest["metadata"]["name"], subresource)
        query = {"fieldManager": field_manager, "force": "true", "fieldValidation": "Strict"}
        query |= {"dryRun": "All"} if dry_run else {}
        return self._object("PATCH", path, query, manifest, APPLY_PATCH)

    def replace(self, manifest: Object, *, subresource: str = "") -> Object:
        """Update the whole object; with its resourceVersion, ApiError 409 if it changed meanwhile."""
        path = self._path(_kind(manifest), _namespace(manifest), manifest["metadata"]["name"], subresource)
        return self._object("PUT", path, {"fieldManager": FIELD_MANAGER, "fieldValidation": "Strict"}, manifest)

    def patch(
        self, kind: str, name: str, patch: Object | Objects, *, namespace: str = "", subresource: str = ""
    ) -> Object:
        """Apply a merge patch (an object) or a JSON patch (a list) and return the object as stored."""
        content_type = JSON_PATCH if isinstance(patch, list) else MERGE_PATCH
        path = self._path(kind, namespace, name, subresource)
        query = {"fieldManager": FIELD_MANAGER, "fieldValidation": "Strict"}
        return self._object("PATCH", path, query, patch, content_type)

    def post(self, kind: str, name: str, subresource: str, body: Object, *, namespace: str = "") -> Object:
        """Post to a subresource (`token`, `eviction`) and return the answer."""
        return self._object("POST", self._path(kind, namespace, name, subresource), body=body)

    def delete(self, kind: str, name: str, *, namespace: str = "", propagation: str = "Background") -> None:
        """Delete the object, which must exist, and its dependents according to `propagation`."""
        options = {"apiVersion": "v1", "kind": "DeleteOptions", "propagationPolicy": propagation}
        self._object("DELETE", self._path(kind, namespace, name), body=options)

    def wait_for(
        self,
        kind: str,
        name: str,
        holds: Callable[[Object], bool],
        *,
        timeout: float = PATIENCE,
        what: str,
        namespace: str = "",
    ) -> Object:
        """Wait until the object exists and `holds` is true for it; return it.

        Raises:
            TimeoutError: with `what` and the object as last seen, after `timeout` seconds.
        """
        found = wait_until(
            lambda: self.find(kind, name, namespace=namespace),
            lambda found: found is not None and holds(found),
            timeout=timeout,
            what=what,
            transient=(Unreachable, KeyError),  # a field, such as the status, may come later than the object
        )
        return cast("Object", found)

    def wait_gone(self, kind: str, name: str, *, timeout: float = PATIENCE, namespace: str = "") -> None:
        """Wait until there is no such object.

        Raises:
            TimeoutError: with the object as last seen, after `timeout` seconds.
        """
        wait_until(
            lambda: self.find(kind, name, namespace=namespace),
            lambda found: found is None,
            timeout=timeout,
            what=f"{kind} {name} is gone",
            transient=(Unreachable,),
        )

    def wait_list(
        self,
        kind: str,
        holds: Callable[[Objects], bool],
        *,
        timeout: float = PATIENCE,
        what: str,
        labels: str = "",
        namespace: str = "",
    ) -> Objects:
        """Wait until `holds` is true for the list of objects; return it.

        Raises:
            TimeoutError: with `what` and the list as last seen, after `timeout` seconds.
        """
        return wait_until(
            lambda: self.list(kind, labels=labels, namespace=namespace),
            holds,
            timeout=timeout,
            what=what,
            transient=(Unreachable,),
        )

    def raw(self, path: str, accept: str = "*/*") -> str:
        """Return the body of a GET of any path, e.g. `/readyz`."""
        return self._request("GET", path, accept=accept)

    def discover(self) -> set[str]:
        """Query the API server for its current kinds and return them."""
        resources: dict[str, Resource] = {}
        for root in ("/api", "/apis"):  # the core group first: its Event has precedence over that of events.k8s.io
            for group in json.loads(self.raw(root, DISCOVERY)).get("items", []):
                group_name = group["metadata"].get("name", "")
                for version in group["versions"]:
                    api_version = f"{group_name}/{version['version']}" if group_name else version["version"]
                    for each in version.get("resources", []):
                        kind = each["responseKind"]["kind"]
                        found = Resource(api_version, each["resource"], each["scope"] == "Namespaced")
                        resources.setdefault(kind, found)  # versions come in the server's order of preference
                        resources.setdefault(f"{kind}.{group_name}", found)
        self._resources = resources
        return set(resources)

    def _path(self, kind: str, namespace: str = "", name: str = "", subresource: str = "") -> str:
        if kind not in self._resources and kind not in self.discover():
            raise LookupError(f"the API server has no kind {kind!r}: misspelt, or a CRD that is not applied?")
        parts = [self._resources[kind].path(namespace or self.namespace), name, subresource]
        return "/".join(part for part in parts if part)

    def _object(
        self,
        method: str,
        path: str,
        query: Mapping[str, str] | None = None,
        body: Object | Objects | None = None,
        content_type: str = "application/json",
    ) -> Object:
        full = f"{path}?{urlencode(query)}" if query else path
        return cast("Object", json.loads(self._request(method, full, body, content_type)))

    def _request(
        self,
        method: str,
        path: str,
        body: Object | Objects | None = None,
        content_type: str = "application/json",
        accept: str = "application/json",
    ) -> str:
        """Return the answer's body; repeat the request if the answer is to retry later."""
        deadline = time.monotonic() + PATIENCE
        while True:
            try:
                return self._send(method, path, body, content_type, accept)
            except ApiError as error:
                if error.code not in COME_BACK or time.monotonic() >= deadline:
                    raise
            time.sleep(INTERVAL)

    def _send(self, method: str, path: str, body: Object | Objects | None, content_type: str, accept: str) -> str:
        headers = {"Accept": accept, "Content-Type": content_type, "Authorization": self._authorization}
        sent = json.dumps(body) if body is not None and content_type == APPLY_PATCH else body
        url = self._client.configuration.host + path
        try:
            response = self._client.rest_client.request(  # type: ignore[no-untyped-call]
                method, url, headers, sent, _request_timeout=PATIENCE
            )
            text = response.read().decode()
        except urllib3.exceptions.HTTPError as error:
            raise Unreachable(f"{method} {url}: {error}") from error
        if response.status >= 400:
            raise _error(response.status, text)
        return str(text)


def _error(code: int, text: str) -> ApiError:
    try:
        status = json.loads(text)
    except ValueError:
        return ApiError(code, "Unknown", text)
    return ApiError(code, status.get("reason", "Unknown"), status.get("message", text))


def _kind(manifest: Object) -> str:
    group, separator, _ = str(manifest["apiVersion"]).partition("/")
    return f"{manifest['kind']}.{group if separator else ''}"


def _namespace(manifest: Object) -> str:
    return str(manifest["metadata"].get("namespace", ""))
