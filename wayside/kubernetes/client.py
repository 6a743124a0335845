"""The API server, as both programs need it: JSON objects in and out, over one shared client of kubernetes.aio.

The generated model classes are not used: they cost more time than the requests, and a manifest is JSON anyway.

An API server that is overloaded or just starting rejects requests with 429, or with 503 and Retry-After. A paced client
retries these after the requested time, and sends nothing else in the meantime. Only an active manager writes: each
write needs its response within the time for which the manager may act, and the API server itself aborts writes that
take longer.
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
_CONNECTING = 2.0  # s for a connection to be opened; less than what lies between an old manager's end and a new one
_PATIENCE = 30.0  # s in which a request is sent again that the API server rejected unprocessed
_FIRST, _MOST = 10, 100  # objects of a list's first page, and of any: each may have 1.5 MB
_PAGE_BYTES = 4 * 1024 * 1024
_RESTARTS = 3  # of a list whose rest is not there any more
_NO_RIGHT = re.compile(r'User ".*" cannot \w+ resource ')  # RBAC's words; a quota refuses with 403 too
_NO_CONNECTION = (TimeoutError, aiohttp.ClientError, OSError)
_NAMESPACE = re.compile(r"/namespaces/([^/]+)/")

NO_ANSWER = "none"
"""The code of a request that the API server did not answer."""


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
    """The verbs. Each raises ApiError where the API server refuses, and Unreachable where it does not answer.

    Attributes:
        may_act: for how many seconds we may write; none or less: not at all, and each write raises NotActive.
        may_write: whether we may write in a namespace; where not, each write raises NotGranted. None: as it comes.
        open_until: until when, on the monotonic clock, a write may yet be done that was sent and not answered.
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
            configuration: where the API server is, and the account.
            program: the name for the API server's audit log.
            field_manager: of what is written.
            remedy: what to do where the account lacks a right.
            measure: gets the method of each request, its seconds and the code of the answer, or NO_ANSWER.
            pacing: lets requests begin; None: each begins at once, and is not sent again.
            timeout: seconds in which a request must be answered.
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
        """Server-side apply, as the one field manager that we are; with `dry_run`, nothing is stored."""
        metadata = manifest["metadata"]
        path = resource.path(metadata["namespace"], metadata["name"])
        query = {**self._strictly, "force": "true", **({"dryRun": "All"} if dry_run else {})}
        return await self._request("PATCH", path, query, manifest, _APPLY)

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
        """Merge into the object; whether it was there."""
        try:
            await self._request("PATCH", resource.path(namespace, name), self._ours, body, _MERGE)
        except ApiError as error:
            if error.code == 404:
                return False
            raise
        return True

    async def patch(self, resource: Resource, namespace: str, name: str, uid: str, changes: Sequence[Object]) -> Object:
        """Apply a JSON patch to the object with this uid; as stored."""
        test = {"op": "test", "path": "/metadata/uid", "value": uid}
        return await self._request("PATCH", resource.path(namespace, name), self._ours, [test, *changes], _JSON_PATCH)

    async def merge_members(self, resource: Resource, name: str, body: Object) -> Object:
        """Merge into an object of the cluster, lists by their members' names."""
        return await self._request("PATCH", resource.path(None, name), self._ours, body, _STRATEGIC)

    async def scale(self, resource: Resource, namespace: str, name: str, version: str, replicas: int) -> Object:
        """Set the replicas of the object by its subresource `scale`, if it is still of this resourceVersion."""
        body = {"metadata": {"resourceVersion": version}, "spec": {"replicas": replicas}}
        return await self._request("PATCH", resource.path(namespace, name, "scale"), self._ours, body, _MERGE)

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
        return await self._request(
            "POST", resource.path(manifest["metadata"]["namespace"]), query=self._ours, body=manifest
        )

    async def replace(self, resource: Resource, manifest: Object) -> Object:
        """Put the object as it is, if it is still of the resourceVersion that the manifest has."""
        metadata = manifest["metadata"]
        return await self._request("PUT", resource.path(metadata["namespace"], metadata["name"]), self._ours, manifest)

    async def review(self, resource: Resource, question: Object) -> Object:
        """Send a query by POST, which changes nothing: a standby may as well."""
        return await self._request("POST", resource.path(None), body=question, writes=False)

    async def server_version(self) -> str:
        """The version of the API server, e.g. v1.36.3."""
        return str((await self._request("GET", "/version"))["gitVersion"])

    async def discover(self, api_version: str) -> dict[tuple[str, str], Resource]:
        """The kinds of a group and version, by apiVersion and kind; none where the cluster does not have it."""
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
        """Send a request; where the client is paced, retry it for up to 30 s while it is rejected unprocessed."""
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
        if not isinstance(status, dict):  # a proxy's page in place of a Status: its beginning is the message
            return ApiError(code, raw[:500].decode(errors="replace"), seconds)
        details = status.get("details") or {}
        causes = tuple(cause.get("reason", "") for cause in details.get("causes") or ())
        message = str(status.get("message", ""))
        if code == 403 and self._remedy and _NO_RIGHT.search(message):
            message = f"{message}: {self._remedy}"
        return ApiError(code, message, seconds, causes, str(status.get("reason") or "Unknown"))


def _unreachable(request: _Request, error: BaseException) -> Unreachable:
    return Unreachable(f"{request.method} {request.path}: {type(error).__name__} {error}".rstrip())
