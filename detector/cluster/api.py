"""Requests to the API server: JSON objects in and out, errors classified by what the caller should do."""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator, AsyncIterator, Mapping
from contextlib import asynccontextmanager
from typing import Any, NamedTuple
from urllib.parse import quote, urlencode

import aiohttp
from kubernetes.aio.client import ApiClient

from detector.cluster.errors import UnavailableError, error_of

JsonObject = dict[str, Any]
"""A Kubernetes object."""

JsonPatch = list[JsonObject]
"""Operations of a JSON patch."""

JSON = "application/json"
JSON_PATCH = "application/json-patch+json"

FIELD_MANAGER = "wayside-detector"
_TIMEOUT = aiohttp.ClientTimeout(total=10.0, sock_connect=5.0)


class Resource(NamedTuple):
    """The API path of a kind."""

    api_version: str
    plural: str

    def path(self, namespace: str, name: str = "") -> str:
        """The path of the namespace's collection, or of one object in it."""
        root = "apis" if "/" in self.api_version else "api"
        collection = f"/{root}/{self.api_version}/namespaces/{quote(namespace)}/{self.plural}"
        return f"{collection}/{quote(name)}" if name else collection


class Api:
    """The verbs, each for a namespace and resource.

    Every verb raises `UnavailableError` if the server does not respond or requests a retry, and another `ApiError` if
    it refuses.
    """

    def __init__(self, client: ApiClient) -> None:
        self._client = client

    async def list(self, resource: Resource, namespace: str, selectors: Mapping[str, str]) -> JsonObject:
        """The list object: its `items`, and its `metadata.resourceVersion` from which a watch continues.

        Args:
            resource: which kind.
            namespace: where.
            selectors: `labelSelector`, `fieldSelector`, or none.
        """
        return await self._request("GET", resource.path(namespace), query=selectors)

    async def get(self, resource: Resource, namespace: str, name: str) -> JsonObject:
        """The object."""
        return await self._request("GET", resource.path(namespace, name))

    async def create(self, resource: Resource, namespace: str, body: JsonObject) -> JsonObject:
        """Create the object; returns it as stored."""
        return await self._request("POST", resource.path(namespace), body, query={"fieldManager": FIELD_MANAGER})

    async def replace(self, resource: Resource, namespace: str, name: str, body: JsonObject) -> JsonObject:
        """Replace the object; returns it as stored."""
        query = {"fieldManager": FIELD_MANAGER}
        return await self._request("PUT", resource.path(namespace, name), body, query=query)

    async def patch(self, resource: Resource, namespace: str, name: str, patch: JsonPatch) -> JsonObject:
        """Apply a JSON patch; returns the object as stored. A `test` of `/metadata/uid` ensures that it is still the
        same object."""
        query = {"fieldManager": FIELD_MANAGER}
        return await self._request("PATCH", resource.path(namespace, name), patch, JSON_PATCH, query=query)

    async def delete(self, resource: Resource, namespace: str, name: str, uid: str) -> None:
        """Delete the object if it still has this uid."""
        options = {"apiVersion": "v1", "kind": "DeleteOptions", "preconditions": {"uid": uid}}
        await self._request("DELETE", resource.path(namespace, name), options)

    async def watch(
        self, resource: Resource, namespace: str, selectors: Mapping[str, str], since: str, seconds: float
    ) -> AsyncGenerator[JsonObject, None]:
        """The changes after the resource version `since`, as they happen, for about `seconds`.

        Yields:
            Watch events: `type` ADDED, MODIFIED or DELETED, and `object`.
        """
        query = {
            **selectors,
            "watch": "true",
            "resourceVersion": since,
            "timeoutSeconds": str(max(1, round(seconds))),
        }
        # The server ends the watch; this timeout ends a connection that died unnoticed.
        timeout = aiohttp.ClientTimeout(total=None, sock_connect=5.0, sock_read=seconds + 5.0)
        async with self._response("GET", resource.path(namespace), query=query, timeout=timeout) as response:
            rest = b""
            async for chunk in response.content.iter_any():
                *lines, rest = (rest + chunk).split(b"\n")
                for line in lines:
                    if not line:
                        continue
                    event: JsonObject = json.loads(line)
                    if event["type"] == "ERROR":
                        status = event["object"]
                        raise error_of(int(status.get("code", 500)), json.dumps(status).encode())
                    yield event

    async def close(self) -> None:
        """Close the connections."""
        await self._client.close()  # type: ignore[no-untyped-call]

    async def _request(
        self,
        method: str,
        path: str,
        body: JsonObject | JsonPatch | None = None,
        content_type: str = JSON,
        query: Mapping[str, str] | None = None,
    ) -> JsonObject:
        async with self._response(method, path, body, content_type, query=query) as response:
            answer: JsonObject = json.loads(await response.read())
            return answer

    @asynccontextmanager
    async def _response(
        self,
        method: str,
        path: str,
        body: JsonObject | JsonPatch | None = None,
        content_type: str = JSON,
        *,
        query: Mapping[str, str] | None = None,
        timeout: aiohttp.ClientTimeout = _TIMEOUT,  # noqa: ASYNC109  aiohttp's own; it also bounds connecting
    ) -> AsyncIterator[aiohttp.ClientResponse]:
        headers = {"Accept": JSON, "Content-Type": content_type}
        url = f"{self._client.configuration.host}{path}" + (f"?{urlencode(query)}" if query else "")
        try:
            # Only the authorization: the generated code around it costs more than the request itself.
            await self._client.update_params_for_auth(headers, [], ["BearerToken"], path, method, body)
            answer = await self._client.rest_client.request(  # type: ignore[no-untyped-call]
                method, url, headers, body, _request_timeout=timeout
            )
            response: aiohttp.ClientResponse = answer.response
            async with response:
                if response.status >= 400:
                    raise error_of(response.status, await response.read(), response.headers.get("Retry-After"))
                yield response
        except (aiohttp.ClientError, TimeoutError, OSError) as error:
            raise UnavailableError(0, "NoAnswer", f"{method} {url}: {error or type(error).__name__}") from error
        except json.JSONDecodeError as error:
            text = f"{method} {url}: the response is truncated or not JSON: {error}"
            raise UnavailableError(0, "NoAnswer", text) from error
