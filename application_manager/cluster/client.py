"""The API server, as the manager needs it: JSON objects in and out, over one shared client of kubernetes.aio.

The generated model classes are left aside: they cost more time than the requests, and a manifest is JSON anyway.

What the API server did not do because it is overloaded or just starting (429, or 503 with Retry-After) is sent again
here, after the time that it requests; nothing else is sent meanwhile. Only an active manager writes: each write has to
be answered within the time for which it may act, and the API server itself gives up what takes longer.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, cast
from urllib.parse import urlencode

import aiohttp
import msgspec
from kubernetes.aio.client import ApiClient, Configuration

from application_manager.cluster.fence import FencedRequest, writing
from application_manager.cluster.pacing import Pacing
from application_manager.core.objects.ownership import FIELD_MANAGER
from application_manager.core.objects.policy import KindKey
from application_manager.core.objects.rights import REMEDY
from application_manager.measures import NO_ANSWER, Measures
from wayside.kubernetes.errors import ApiError, NotActive, NotGranted, Unreachable

Object = dict[str, Any]
"""A Kubernetes object, as JSON."""

_APPLY = "application/apply-patch+yaml"
_MERGE = "application/merge-patch+json"
_STRATEGIC = "application/strategic-merge-patch+json"
_JSON = "application/json"
_TIMEOUT = 15.0  # s for one request
_CONNECTING = 2.0  # s for a connection to be opened; less than what lies between an old manager's end and a new one
_PATIENCE = 30.0  # s in which a request is sent again that the API server rejected unprocessed
_FIRST, _MOST = 10, 100  # objects of a list's first page, and of any: each may have 1.5 MB
_PAGE_BYTES = 4 * 1024 * 1024
_RESTARTS = 3  # of a list whose rest is not there any more
_NO_RIGHT = re.compile(r'User ".*" cannot \w+ resource ')  # RBAC's words; a quota refuses with 403 too
_NAMESPACE = re.compile(r"/namespaces/([^/]+)/")
_OURS: Mapping[str, str] = {"fieldManager": FIELD_MANAGER}
_STRICTLY: Mapping[str, str] = {**_OURS, "fieldValidation": "Strict"}


@dataclass(frozen=True, slots=True)
class Resource:
    """Where a kind lives."""

    api_version: str
    kind: str
    plural: str
    namespaced: bool = True

    @property
    def group(self) -> str:
        """The API group, empty for the core group."""
        return self.api_version.rpartition("/")[0]

    @property
    def version(self) -> str:
        """The version within the group."""
        return self.api_version.rpartition("/")[2]

    def path(self, namespace: str | None, name: str = "", subresource: str = "") -> str:
        """The path of the collection (over all namespaces for None), or of the object named."""
        root = f"/apis/{self.api_version}" if self.group else f"/api/{self.api_version}"
        scope = f"/namespaces/{namespace}" if self.namespaced and namespace else ""
        return "/".join(part for part in (f"{root}{scope}/{self.plural}", name, subresource) if part)


LEASES = Resource("coordination.k8s.io/v1", "Lease", "leases")
EVENTS = Resource("events.k8s.io/v1", "Event", "events")


@dataclass(frozen=True, slots=True)
class _Request:
    """A request; `writes`: whether it changes something."""

    method: str
    path: str
    query: Mapping[str, str]
    body: Object | None = None
    content_type: str = _JSON
    writes: bool = False


class _ListMetadata(msgspec.Struct):
    resource_version: str = msgspec.field(name="resourceVersion")
    rest: str = msgspec.field(name="continue", default="")


class _Page(msgspec.Struct):
    metadata: _ListMetadata
    items: list[msgspec.Raw] | None = None


_DECODE_PAGE = msgspec.json.Decoder(_Page).decode


class Client:
    """The verbs. Each raises ApiError where the API server refuses, and Unreachable where it does not answer.

    Attributes:
        may_act: for how many seconds we may write; none or less: not at all, and each write raises NotActive.
        may_write: whether we may write in a namespace; where not, each write raises NotGranted. None: as it comes.
        open_until: until when, on the monotonic clock, a write may yet be done that was sent and not answered.
    """

    def __init__(
        self,
        configuration: Configuration,
        measures: Measures | None = None,
        *,
        pacing: Pacing | None = None,
        timeout: float = _TIMEOUT,
        may_act: Callable[[], float] = lambda: math.inf,
    ) -> None:
        """`timeout`: seconds in which a request must be answered."""
        self.configuration = configuration
        self.may_act = may_act
        self.may_write: Callable[[str], Awaitable[bool]] | None = None
        self.open_until = 0.0
        self._measures = measures or Measures()
        self._pacing = pacing or Pacing()
        self._timeout = timeout
        configuration.client_session_kwargs = {"request_class": FencedRequest}
        self._api: Any = ApiClient(configuration)
        self._decode = msgspec.json.Decoder().decode

    async def close(self) -> None:
        """Close the connections."""
        await self._api.close()

    async def get(self, resource: Resource, namespace: str, name: str) -> Object | None:
        """The object, or None."""
        try:
            found = await self._request("GET", resource.path(namespace, name))
            return {"apiVersion": resource.api_version, "kind": resource.kind, **found}
        except ApiError as error:
            if error.code == 404:
                return None
            raise

    async def pages(
        self, resource: Resource, namespace: str | None, *, labels: str = "", fields: str = "", size: int = _FIRST
    ) -> AsyncIterator[tuple[Iterator[Object], str]]:
        """The objects and the version of `list`, page by page: `size` at first, then as many as make some 4 MiB.

        Each object is decoded when it is reached: Python needs up to twenty times the size of the text. When
        the rest of the list has expired (410), it restarts, and objects may come twice.
        """
        kind = {"apiVersion": resource.api_version, "kind": resource.kind}
        query = {"labelSelector": labels, "fieldSelector": fields}
        rest, restarts = "", 0
        while True:
            page = {key: value for key, value in {**query, "limit": str(size), "continue": rest}.items() if value}
            try:
                text = await self._send(_Request("GET", resource.path(namespace), page))
            except ApiError as error:
                if error.code != 410 or not rest or restarts == _RESTARTS:
                    raise
                rest, restarts = "", restarts + 1
                continue
            answer = _DECODE_PAGE(text)
            size = max(1, min(_MOST, _PAGE_BYTES * len(answer.items or ()) // len(text)))
            del text
            yield ({**kind, **self._decode(item)} for item in answer.items or ()), answer.metadata.resource_version
            rest = answer.metadata.rest
            if not rest:
                return

    async def list(
        self, resource: Resource, namespace: str | None, *, labels: str = "", fields: str = "", limit: int = 0
    ) -> tuple[list[Object], str]:
        """The objects, with apiVersion and kind, and the resourceVersion of the list; read from the storage itself.

        `limit`: the maximum number of objects; 0: no limit.
        """
        found: list[Object] = []
        version = ""
        async for page, as_of in self.pages(resource, namespace, labels=labels, fields=fields, size=limit or _FIRST):
            found += page
            version = as_of
            if limit:
                break
        return found, version

    async def apply(self, resource: Resource, manifest: Object, *, dry_run: bool = False) -> Object:
        """Server-side apply, as the one field manager that we are; with `dry_run`, nothing is stored."""
        metadata = manifest["metadata"]
        path = resource.path(metadata["namespace"], metadata["name"])
        query = {**_STRICTLY, "force": "true", **({"dryRun": "All"} if dry_run else {})}
        return await self._request("PATCH", path, query, manifest, _APPLY)

    async def patch_status(self, resource: Resource, namespace: str, name: str, uid: str, status: Object) -> Object:
        """Merge into the status of the object with this uid; null removes a field."""
        body = {"metadata": {"uid": uid}, "status": status}
        return await self._request("PATCH", resource.path(namespace, name, "status"), _STRICTLY, body, _MERGE)

    async def annotate(
        self, resource: Resource, namespace: str, name: str, uid: str, annotations: Mapping[str, str]
    ) -> Object:
        """Set annotations of the object with this uid, and touch nothing else."""
        body = {"metadata": {"uid": uid, "annotations": dict(annotations)}}
        return await self._request("PATCH", resource.path(namespace, name), _STRICTLY, body, _MERGE)

    async def merge(self, resource: Resource, namespace: str, name: str, body: Object) -> bool:
        """Merge into the object; whether it was there."""
        try:
            await self._request("PATCH", resource.path(namespace, name), _OURS, body, _MERGE)
        except ApiError as error:
            if error.code == 404:
                return False
            raise
        return True

    async def merge_members(self, resource: Resource, name: str, body: Object) -> Object:
        """Merge into an object of the cluster, lists by their members' names."""
        return await self._request("PATCH", resource.path(None, name), _OURS, body, _STRATEGIC)

    async def scale(self, resource: Resource, namespace: str, name: str, version: str, replicas: int) -> Object:
        """Set the replicas of the object by its subresource `scale`, if it is still of this resourceVersion."""
        body = {"metadata": {"resourceVersion": version}, "spec": {"replicas": replicas}}
        return await self._request("PATCH", resource.path(namespace, name, "scale"), _OURS, body, _MERGE)

    async def delete(self, resource: Resource, namespace: str, name: str, uid: str) -> bool:
        """Delete the object with this uid, and in the background what it owns. Returns whether it was there."""
        options = {
            "apiVersion": "v1",
            "kind": "DeleteOptions",
            "propagationPolicy": "Background",
            "preconditions": {"uid": uid},
        }
        try:
            await self._request("DELETE", resource.path(namespace, name), body=options)
        except ApiError as error:
            if error.code in (404, 409):  # gone, or another object of the same name
                return False
            raise
        return True

    async def create(self, resource: Resource, manifest: Object) -> Object:
        """Create the object."""
        return await self._request("POST", resource.path(manifest["metadata"]["namespace"]), body=manifest)

    async def replace(self, resource: Resource, manifest: Object) -> Object:
        """Put the object as it is, if it is still of the resourceVersion that the manifest has."""
        metadata = manifest["metadata"]
        return await self._request("PUT", resource.path(metadata["namespace"], metadata["name"]), body=manifest)

    async def review(self, resource: Resource, question: Object) -> Object:
        """Ask something by posting it, which changes nothing: a standby may as well."""
        return await self._request("POST", resource.path(None), body=question, writes=False)

    async def server_version(self) -> str:
        """The version of the API server, e.g. v1.36.3."""
        return str((await self._request("GET", "/version"))["gitVersion"])

    async def discover(self, api_version: str) -> dict[KindKey, Resource]:
        """The kinds of a group and version; none where the cluster does not have it."""
        root = f"/apis/{api_version}" if "/" in api_version else f"/api/{api_version}"
        try:
            answer = await self._request("GET", root)
        except ApiError as error:
            if error.code == 404:
                return {}
            raise
        return {
            (api_version, each["kind"]): Resource(api_version, each["kind"], each["name"], each["namespaced"])
            for each in answer["resources"]
            if "/" not in each["name"]
        }

    async def _request(
        self,
        method: str,
        path: str,
        query: Mapping[str, str] | None = None,
        body: Object | None = None,
        content_type: str = _JSON,
        *,
        writes: bool | None = None,
    ) -> Object:
        changes = method != "GET" if writes is None else writes
        return cast(
            "Object", self._decode(await self._send(_Request(method, path, query or {}, body, content_type, changes)))
        )

    async def _send(self, request: _Request) -> bytes:
        """Send a request, and retry it for up to 30 s while the API server rejects it unprocessed."""
        deadline = time.monotonic() + _PATIENCE
        found = _NAMESPACE.search(request.path)
        namespace = found[1] if found is not None and request.writes else ""
        if namespace and self.may_write is not None and not await self.may_write(namespace):
            raise NotGranted(namespace)
        while True:
            try:
                async with self._pacing.turn(namespace):
                    return await self._send_once(request)
            except ApiError as error:
                if error.code not in (429, 503) or error.retry_after is None:
                    raise
                self._pacing.hold(error.retry_after)
                if time.monotonic() + error.retry_after > deadline:
                    raise

    async def _send_once(self, request: _Request) -> bytes:
        headers = {"Accept": _JSON, "Content-Type": request.content_type, "User-Agent": "wayside-application-manager"}
        token = await self.configuration.get_api_key_with_prefix("BearerToken", alias="authorization")
        if token:
            headers["Authorization"] = token
        seconds, query = self._timeout, dict(request.query)
        writing.set(self.may_act if request.writes else None)
        if request.writes:
            seconds = min(seconds, self.may_act())
            if seconds <= 0:
                raise NotActive
            query["timeout"] = f"{max(1, int(seconds * 1000))}ms"  # the API server gives up when we do
        limit = aiohttp.ClientTimeout(total=seconds, connect=_CONNECTING if request.writes else None)
        url = self.configuration.host + request.path + (f"?{urlencode(query)}" if query else "")
        began, code = time.monotonic(), NO_ANSWER
        try:
            response = await self._api.rest_client.request(
                request.method, url, headers=headers, body=request.body, _request_timeout=limit
            )
            raw = await response.read()
            code = str(response.status)
        except (TimeoutError, aiohttp.ClientError, OSError) as error:
            what = f"{request.method} {request.path}: {type(error).__name__} {error}"
            raise Unreachable(what.rstrip()) from error
        finally:
            if request.writes and code == NO_ANSWER:
                self.open_until = max(self.open_until, began + seconds)
            self._measures.requested(request.method, time.monotonic() - began, code)
        if response.status >= 400:
            raise self._error(response.status, raw, response.headers.get("Retry-After"))
        return cast("bytes", raw)

    def _error(self, code: int, raw: bytes, retry_after: str | None) -> ApiError:
        seconds = float(retry_after) if retry_after and retry_after.isdigit() else None
        try:
            status = self._decode(raw)
        except msgspec.DecodeError:
            return ApiError(code, raw[:500].decode(errors="replace"), seconds)
        details = status.get("details") or {}
        causes = tuple(cause.get("reason", "") for cause in details.get("causes") or ())
        message = str(status.get("message", ""))
        if code == 403 and _NO_RIGHT.search(message):
            message = f"{message}: {REMEDY}"
        return ApiError(code, message, seconds, causes)
