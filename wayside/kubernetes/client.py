"""The Kubernetes client of both programs: JSON objects in and out, over one shared client of kubernetes.aio.

The generated model classes are not used: they take more time than the requests, and a manifest is JSON anyway.

An API server that is overloaded or just starting rejects requests with 429, or with 503 and Retry-After. A paced client
retries these after the requested time, and sends nothing else in the meantime. Only an active manager writes: the
timeout of each write is at most the time for which the manager may act, and the API server aborts writes that take
longer.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast
from urllib.parse import urlencode

import aiohttp
import msgspec
from kubernetes.aio.client import ApiClient, Configuration

from wayside.kubernetes.errors import ApiError, NotActive, NotGranted, Unreachable
from wayside.kubernetes.fence import FencedRequest, writing
from wayside.kubernetes.pacing import LONGEST_HOLD, Pacing
from wayside.kubernetes.resources import Object, Resource

_APPLY = "application/apply-patch+yaml"
_MERGE = "application/merge-patch+json"
_JSON_PATCH = "application/json-patch+json"
_STRATEGIC = "application/strategic-merge-patch+json"
_JSON = "application/json"
_TIMEOUT = 15.0  # s for one request
_CONNECTING = 2.0  # s to open a connection; less than the pause between an old manager and a new one
_PATIENCE = 30.0  # s in which a request that the API server rejected unprocessed is retried
_FIRST, _MOST = 10, 100  # objects of the first page of a list, and of any page; an object may have 1.5 MB
_PAGE_BYTES = 4 * 1024 * 1024
_RESTARTS = 3  # of a list whose remaining pages have expired
_NO_RIGHT = re.compile(r'User ".*" cannot \w+ resource ')  # the message of RBAC; a quota also refuses with 403
_NO_CONNECTION = (TimeoutError, aiohttp.ClientError, OSError)
_NAMESPACE = re.compile(r"/namespaces/([^/]+)/")

NO_ANSWER = "none"
"""The code of a request without a response of the API server."""


@dataclass(frozen=True, slots=True)
class _Request:
    """A request; `writes`: whether it changes something."""

    method: str
    path: str
    query: Mapping[str, str]
    body: Object | Sequence[Object] | None = None
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
    """The verbs. Each raises ApiError if the API server refuses the request, and Unreachable if it does not respond.

    Attributes:
        may_act: the number of seconds for which the client may write; if it is 0 or less, each write raises NotActive.
        may_write: whether the client may write in a namespace; if not, each write raises NotGranted. None: not checked.
        open_until: the time on the monotonic clock until which a write without a response may still be executed.
    """

    def __init__(
        self,
        configuration: Configuration,
        program: str,
        *,
        field_manager: str,
        remedy: str = "",
        measure: Callable[[str, float, str], None] | None = None,
        pacing: Pacing | None = None,
        timeout: float = _TIMEOUT,
    ) -> None:
        """Prepare; nothing is sent yet.

        Args:
            configuration: the address of the API server, and the account.
            program: the user agent, for the API server's audit log.
            field_manager: the field manager of all writes.
            remedy: the remedy for a missing right, for the error's text.
            measure: receives the method of each request, its seconds, and the code of the response or NO_ANSWER.
            pacing: decides when requests start; None: each starts at once, and is not retried.
            timeout: the timeout of a request, in seconds.
        """
        self.configuration = configuration
        self.may_act: Callable[[], float] = lambda: math.inf
        self.may_write: Callable[[str], Awaitable[bool]] | None = None
        self.open_until = 0.0
        self._program = program
        self._ours = {"fieldManager": field_manager}
        self._strictly = {**self._ours, "fieldValidation": "Strict"}
        self._remedy = remedy
        self._measure = measure
        self._pacing = pacing
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
        """Yields the pages of a list, each with the resourceVersion of the list.

        The first page has `size` objects, later pages about 4 MiB. Each object is decoded when it is iterated, since
        decoding multiplies its size by up to twenty. If the remaining pages have expired (410), the list restarts, and
        objects may be yielded twice.
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
        """The objects, with apiVersion and kind, and the resourceVersion of the list: a consistent read.

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

    async def watch(
        self, resource: Resource, namespace: str, *, labels: str = "", fields: str = "", since: str, seconds: float
    ) -> AsyncGenerator[Object, None]:
        """The changes after the resourceVersion `since`, as they happen, for about `seconds`; not paced.

        Yields:
            Watch events: `type` ADDED, MODIFIED or DELETED, and `object`.
        """
        query = {"labelSelector": labels, "fieldSelector": fields, "watch": "true", "resourceVersion": since}
        query["timeoutSeconds"] = str(max(1, round(seconds)))
        request = _Request("GET", resource.path(namespace), {key: value for key, value in query.items() if value})
        # The server ends the watch by itself; a connection that died unnoticed ends by this timeout instead.
        limit = aiohttp.ClientTimeout(total=None, sock_connect=5.0, sock_read=seconds + 5.0)
        url = f"{self.configuration.host}{request.path}?{urlencode(request.query)}"
        writing.set(None)
        try:
            answer = await self._api.rest_client.request(
                "GET", url, headers=await self._headers(), _request_timeout=limit
            )
            async with answer.response as response:
                if response.status >= 400:
                    raise self._error(response.status, await response.read(), response.headers.get("Retry-After"))
                rest = b""
                async for chunk in response.content.iter_any():
                    *lines, rest = (rest + chunk).split(b"\n")
                    for line in filter(None, lines):
                        event: Object = self._decode(line)
                        if event["type"] == "ERROR":
                            status = event["object"]
                            raise self._error(int(status.get("code", 500)), msgspec.json.encode(status), None)
                        yield event
        except (*_NO_CONNECTION, msgspec.DecodeError) as error:
            raise _unreachable(request, error) from error

    async def apply(self, resource: Resource, manifest: Object, *, dry_run: bool = False) -> Object:
        """Server-side apply with force, as this client's field manager. With `dry_run`, nothing is stored."""
        metadata = manifest["metadata"]
        path = resource.path(metadata["namespace"], metadata["name"])
        query = {**self._strictly, "force": "true", **({"dryRun": "All"} if dry_run else {})}
        return await self._request("PATCH", path, query, manifest, _APPLY, writes=not dry_run)

    async def patch_status(self, resource: Resource, namespace: str, name: str, uid: str, status: Object) -> Object:
        """Merge into the status of the object with this uid; null removes a field."""
        body = {"metadata": {"uid": uid}, "status": status}
        return await self._request("PATCH", resource.path(namespace, name, "status"), self._strictly, body, _MERGE)

    async def annotate(
        self, resource: Resource, namespace: str, name: str, uid: str, annotations: Mapping[str, str]
    ) -> Object:
        """Set annotations of the object with this uid, and touch nothing else."""
        body = {"metadata": {"uid": uid, "annotations": dict(annotations)}}
        return await self._request("PATCH", resource.path(namespace, name), self._strictly, body, _MERGE)

    async def merge(self, resource: Resource, namespace: str, name: str, body: Object) -> bool:
        """Merge into the object. Returns whether it exists."""
        try:
            await self._request("PATCH", resource.path(namespace, name), self._ours, body, _MERGE)
        except ApiError as error:
            if error.code == 404:
                return False
            raise
        return True

    async def patch(self, resource: Resource, namespace: str, name: str, uid: str, changes: Sequence[Object]) -> Object:
        """Apply a JSON patch to the object with this uid. Returns the object as stored."""
        test = {"op": "test", "path": "/metadata/uid", "value": uid}
        return await self._request("PATCH", resource.path(namespace, name), self._ours, [test, *changes], _JSON_PATCH)

    async def merge_members(self, resource: Resource, name: str, body: Object) -> Object:
        """Merge into a cluster-scoped object; lists are merged by the names of their items."""
        return await self._request("PATCH", resource.path(None, name), self._ours, body, _STRATEGIC)

    async def scale(self, resource: Resource, namespace: str, name: str, version: str, replicas: int) -> Object:
        """Set the replicas of the object by its subresource `scale`, if it still has this resourceVersion."""
        body = {"metadata": {"resourceVersion": version}, "spec": {"replicas": replicas}}
        return await self._request("PATCH", resource.path(namespace, name, "scale"), self._ours, body, _MERGE)

    async def delete(self, resource: Resource, namespace: str, name: str, uid: str) -> bool:
        """Delete the object with this uid, and in the background its dependents. Returns whether it existed."""
        options = {
            "apiVersion": "v1",
            "kind": "DeleteOptions",
            "propagationPolicy": "Background",
            "preconditions": {"uid": uid},
        }
        try:
            await self._request("DELETE", resource.path(namespace, name), body=options)
        except ApiError as error:
            if error.code in (404, 409):  # it does not exist, or has another uid
                return False
            raise
        return True

    async def create(self, resource: Resource, manifest: Object) -> Object:
        """Create the object."""
        return await self._request(
            "POST", resource.path(manifest["metadata"]["namespace"]), query=self._ours, body=manifest
        )

    async def replace(self, resource: Resource, manifest: Object) -> Object:
        """Replace the object, if it still has the resourceVersion of the manifest."""
        metadata = manifest["metadata"]
        return await self._request("PUT", resource.path(metadata["namespace"], metadata["name"]), self._ours, manifest)

    async def review(self, resource: Resource, question: Object) -> Object:
        """Send a review by POST. It changes nothing, so a standby may send it too."""
        return await self._request("POST", resource.path(None), body=question, writes=False)

    async def server_version(self) -> str:
        """The version of the API server, e.g. v1.36.3."""
        return str((await self._request("GET", "/version"))["gitVersion"])

    async def discover(self, api_version: str) -> dict[tuple[str, str], Resource]:
        """The kinds of a group and version, by apiVersion and kind; empty if the cluster does not have the group."""
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
        body: Object | Sequence[Object] | None = None,
        content_type: str = _JSON,
        *,
        writes: bool | None = None,
    ) -> Object:
        changes = method != "GET" if writes is None else writes
        request = _Request(method, path, query or {}, body, content_type, changes)
        return cast("Object", self._decode(await self._send(request)))

    async def check_granted(self, namespace: str) -> None:
        """Raise NotGranted unless the client may write in the namespace; each write checks this by itself."""
        if namespace and self.may_write is not None and not await self.may_write(namespace):
            raise NotGranted(namespace)

    async def _send(self, request: _Request) -> bytes:
        """Send a request. A paced client retries it for up to 30 s while the API server rejects it unprocessed."""
        deadline = time.monotonic() + _PATIENCE
        found = _NAMESPACE.search(request.path)
        namespace = found[1] if found is not None and request.writes else ""
        await self.check_granted(namespace)
        if (pacing := self._pacing) is None:
            return await self._send_once(request)
        while True:
            try:
                async with pacing.turn(namespace):
                    return await self._send_once(request)
            except ApiError as error:
                if error.code not in (429, 503) or error.retry_after is None:
                    raise
                pacing.hold(error.retry_after)
                if time.monotonic() + error.retry_after > deadline:
                    raise

    async def _send_once(self, request: _Request) -> bytes:
        headers = await self._headers(request.content_type)
        seconds, query = self._timeout, dict(request.query)
        writing.set(self.may_act if request.writes else None)
        if request.writes:
            seconds = min(seconds, self.may_act())
            if seconds <= 0:
                raise NotActive
            query["timeout"] = f"{max(1, int(seconds * 1000))}ms"  # the API server gives up at the same time
        limit = aiohttp.ClientTimeout(total=seconds, connect=_CONNECTING if request.writes else None)
        url = self.configuration.host + request.path + (f"?{urlencode(query)}" if query else "")
        began, code = time.monotonic(), NO_ANSWER
        try:
            response = await self._api.rest_client.request(
                request.method, url, headers=headers, body=request.body, _request_timeout=limit
            )
            raw = await response.read()
            code = str(response.status)
        except _NO_CONNECTION as error:
            raise _unreachable(request, error) from error
        finally:
            if request.writes and code == NO_ANSWER:
                self.open_until = max(self.open_until, began + seconds)
            if self._measure is not None:
                self._measure(request.method, time.monotonic() - began, code)
        if response.status >= 400:
            raise self._error(response.status, raw, response.headers.get("Retry-After"))
        return cast("bytes", raw)

    async def _headers(self, content_type: str = _JSON) -> dict[str, str]:
        headers = {"Accept": _JSON, "Content-Type": content_type, "User-Agent": self._program}
        token = await self.configuration.get_api_key_with_prefix("BearerToken", alias="authorization")
        return {**headers, "Authorization": token} if token else headers

    def _error(self, code: int, raw: bytes, retry_after: str | None) -> ApiError:
        seconds = min(float(retry_after), LONGEST_HOLD) if retry_after and retry_after.isdigit() else None
        try:
            status = self._decode(raw)
        except (msgspec.DecodeError, UnicodeDecodeError):
            status = None
        if not isinstance(status, dict):  # a proxy's page instead of a Status: its beginning is the message
            return ApiError(code, raw[:500].decode(errors="replace"), seconds)
        details = status.get("details") or {}
        causes = tuple(cause.get("reason", "") for cause in details.get("causes") or ())
        message = str(status.get("message", ""))
        if code == 403 and self._remedy and _NO_RIGHT.search(message):
            message = f"{message}: {self._remedy}"
        return ApiError(code, message, seconds, causes, str(status.get("reason") or "Unknown"))


def _unreachable(request: _Request, error: BaseException) -> Unreachable:
    return Unreachable(f"{request.method} {request.path}: {type(error).__name__} {error}".rstrip())
