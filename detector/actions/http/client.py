"""One HTTP request and its response, in the calling thread, with a deadline that always holds.

An endpoint may hang, send a byte a second, announce more than it sends, or send endlessly. aiohttp runs the exchange as
a task of an event loop that lives as long as the request: a task can be ended at any moment, which a blocking socket
cannot. Each request uses a separate connection that is closed afterwards, and reads no more than requested.

Headers and certificates are read for each request: a renewed Secret takes effect at once. The message of a failure
names the endpoint's scheme, host and port only: paths and queries may hold secrets.
"""

from __future__ import annotations

import asyncio
import base64
import os
import socket
import ssl
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import aiohttp
from aiohttp.abc import AbstractResolver, ResolveResult
from yarl import URL

from detector.access import AccessError, TlsFiles, login, secret_text, tls_files, variable_text
from detector.actions.http.answer import Answer
from wayside.api.actions.http import HttpAccess, HttpHeader


@dataclass(frozen=True, slots=True)
class Headers:
    """The headers of the resource, and the secret texts in them."""

    values: Mapping[str, str]
    secrets: tuple[str, ...]

    def __repr__(self) -> str:
        return f"Headers({', '.join(self.values)})"

    def strike_out(self, text: str) -> str:
        """The text without secrets: an endpoint may repeat what it received."""
        for secret in sorted(self.secrets, key=len, reverse=True):
            text = text.replace(secret, "***")
        return text


def read_headers(access: HttpAccess, field: str) -> Headers:
    """Raises AccessError, with the field and never a secret in its text."""
    values: dict[str, str] = {}
    secrets: list[str] = []
    for index, header in enumerate(access.headers):
        at = f"{field}.headers[{index}]"
        value = _value(header, at)
        if any(character in value for character in "\r\n\0"):
            raise AccessError(
                f"{at}: the value has line breaks, which an HTTP header cannot have: write it on one line"
            )
        values[header.name] = value
        if header.value is None and value:
            secrets += [value, *(part for part in value.split() if len(part) >= 4)]
    known = login(access.access, field)
    if known is not None:
        basic = base64.b64encode(f"{known.username}:{known.password}".encode()).decode()
        values["Authorization"] = f"Basic {basic}"
        secrets += [basic, *([known.password] if known.password else [])]
    return Headers(values, tuple(secrets))


def _value(header: HttpHeader, at: str) -> str:
    if header.secret_key_ref is not None:
        return secret_text(header.secret_key_ref.name, header.secret_key_ref.key, f"{at}.secretKeyRef")
    if header.variable is not None:
        return variable_text(header.variable, f"{at}.variable")
    return header.value or ""


class TlsContexts:
    """The TLS context of one endpoint, rebuilt when its files change."""

    def __init__(self) -> None:
        self._made: tuple[object, ssl.SSLContext] | None = None

    def get(self, access: HttpAccess, field: str) -> ssl.SSLContext:
        """Raises AccessError."""
        files = tls_files(access.access, field)
        now = (files, _stamps(files))
        if self._made is None or self._made[0] != now:
            self._made = now, _context(files, field)
        return self._made[1]


def _stamps(files: TlsFiles | None) -> tuple[tuple[int, int], ...]:
    paths = () if files is None else (files.ca, files.certificate, files.key)
    stats = [os.stat(path) for path in paths if path is not None]
    return tuple((stat.st_mtime_ns, stat.st_ino) for stat in stats)


def _context(files: TlsFiles | None, field: str) -> ssl.SSLContext:
    if files is None:
        return ssl.create_default_context()
    try:
        return files.context()
    except (ssl.SSLError, OSError) as error:
        places = ", ".join(str(path) for path in (files.ca, files.certificate, files.key) if isinstance(path, Path))
        raise AccessError(f"{field}: cannot read certificates from {places}: give files in PEM format") from error


_REFUSAL = 4096
"""Maximum bytes read of a refusal, for its excerpt."""
_REFUSAL_TIME = 1.0
"""Maximum seconds spent on it."""
_EXCERPT = 200
"""Maximum characters of it in a message."""
_CHECK_EVERY = 0.05
"""Seconds between two checks of whether to give up."""


class HttpError(Exception):
    """A request without a response; the message gives the reason, and contains no secret."""


@dataclass(frozen=True, slots=True)
class _Exchange:
    method: str
    url: URL
    headers: Headers
    own_headers: Mapping[str, str]
    body: bytes
    tls: ssl.SSLContext | None
    timeout: float
    want: int

    @property
    def where(self) -> str:
        return origin(self.url)


class HttpClient:
    """Sends requests to endpoints with the same access settings. One request at a time."""

    def __init__(self, access: HttpAccess, field: str) -> None:
        """`field` is the place of `access` in the rule: error messages begin with it."""
        self._access, self._field = access, field
        self._tls = TlsContexts()

    def send(
        self,
        method: str,
        url: str,
        headers: Mapping[str, str],
        body: bytes,
        *,
        want: int = 0,
        give_up: Callable[[], bool] = lambda: False,
    ) -> Answer:
        """Send a request and wait for its response, at most for the timeout of the access.

        Args:
            method: e.g. POST.
            url: http or https, as in the resource.
            headers: of this request; those of the access come on top.
            body: may be empty.
            want: maximum bytes of the body of a success that are read; with 0, its status is enough. Of a refusal some
                hundred bytes are read in any case.
            give_up: polled twenty times a second; once it is true, the request is aborted.

        Raises:
            HttpError: there was no response, or a header or certificate is missing at the path that the resource names.
        """
        try:
            target = URL(url, encoded=True)
            exchange = _Exchange(
                method,
                target,
                read_headers(self._access, self._field),
                headers,
                body,
                self._tls.get(self._access, self._field) if target.scheme == "https" else None,
                self._access.timeout.seconds,
                want,
            )
        except (AccessError, OSError, ValueError) as error:
            raise HttpError(str(error) if isinstance(error, AccessError) else type(error).__name__) from error
        return asyncio.run(_watched(exchange, give_up))


def origin(url: URL) -> str:
    """The part of a URL that may be logged: scheme, host and port."""
    return f"{url.scheme}://{url.host}:{url.port}"


async def _watched(exchange: _Exchange, give_up: Callable[[], bool]) -> Answer:
    task = asyncio.create_task(_answer(exchange))
    try:
        while not task.done():
            if give_up():
                raise HttpError(f"{exchange.where}: aborted before the response, because the detector is stopping")
            await asyncio.wait({task}, timeout=_CHECK_EVERY)
        return task.result()
    finally:
        task.cancel()


async def _answer(exchange: _Exchange) -> Answer:
    try:
        async with asyncio.timeout(exchange.timeout):
            return await _exchange(exchange)
    except TimeoutError as error:
        raise HttpError(f"{exchange.where}: no answer within {exchange.timeout:g} s") from error
    except (aiohttp.ClientError, OSError, ValueError) as error:
        raise HttpError(f"{exchange.where}: {_why(error)}") from error


async def _exchange(exchange: _Exchange) -> Answer:
    connector = aiohttp.TCPConnector(
        ssl=exchange.tls or True, resolver=Resolver(), use_dns_cache=False, force_close=True
    )
    session = aiohttp.ClientSession(
        connector=connector,
        cookie_jar=aiohttp.DummyCookieJar(),
        auto_decompress=False,
        timeout=aiohttp.ClientTimeout(total=None),  # the deadline is around all of it
        skip_auto_headers=("User-Agent", "Accept-Encoding", "Content-Type"),
    )
    headers = {"User-Agent": "wayside", "Accept-Encoding": "identity", **exchange.own_headers}
    try:
        response = await session.request(
            exchange.method,
            exchange.url,
            headers={**headers, **exchange.headers.values},
            data=exchange.body or None,
            allow_redirects=False,
        )
        try:
            return await _read(exchange, response)
        finally:
            response.close()
    finally:
        await connector.close(abort_ssl=True)
        await session.close()


async def _read(exchange: _Exchange, response: aiohttp.ClientResponse) -> Answer:
    headers = {name.lower(): value for name, value in response.headers.items()}
    if 200 <= response.status < 300:
        body, whole = await _body(response, exchange.want) if exchange.want else (b"", True)
        return Answer(response.status, body, whole, headers)
    try:
        async with asyncio.timeout(_REFUSAL_TIME):
            body, whole = await _body(response, _REFUSAL)
    except TimeoutError:
        body, whole = b"", False
    excerpt = exchange.headers.strike_out(body.decode(errors="replace"))
    printable = "".join(character if character.isprintable() else " " for character in excerpt)
    excerpt = " ".join(printable.split())[:_EXCERPT]
    return Answer(response.status, body, whole, headers, excerpt)


async def _body(response: aiohttp.ClientResponse, limit: int) -> tuple[bytes, bool]:
    """At most `limit` bytes of the body, and whether this is all of it."""
    read = bytearray()
    try:
        while len(read) <= limit:
            chunk = await response.content.read(limit + 1 - len(read))
            if not chunk:
                return bytes(read), True
            read += chunk
    except aiohttp.ClientError:  # less arrived than was announced
        return bytes(read), False
    return bytes(read[:limit]), False


def _why(error: Exception) -> str:
    """The error without the URL, which aiohttp's messages may contain."""
    match error:
        case aiohttp.ClientConnectorCertificateError():
            found = error.certificate_error
            return f"its certificate is not trusted: {getattr(found, 'verify_message', '') or found}"
        case aiohttp.ClientConnectorDNSError():
            return f"cannot resolve the host name: {error.os_error.strerror or error.os_error}"
        case aiohttp.ClientConnectorSSLError():
            return f"TLS handshake failed: {getattr(error.os_error, 'reason', None) or 'it speaks another protocol'}"
        case aiohttp.ClientConnectorError():
            return f"cannot connect: {error.os_error.strerror or error.os_error}"
        case aiohttp.ServerDisconnectedError():
            return "it closed the connection without a response"
        case aiohttp.ClientResponseError():
            return "its response is not HTTP"
        case OSError():
            return f"the connection broke: {error.strerror or type(error).__name__}"
        case _:
            return type(error).__name__


class Resolver(AbstractResolver):
    """Resolves names by the system's resolver, each in a daemon thread that is never joined.

    The system's resolver cannot be interrupted. On a vehicle without a network it hangs for many seconds, and the
    process waits at its end for the threads of an executor, but not for these.
    """

    async def resolve(
        self, host: str, port: int = 0, family: socket.AddressFamily = socket.AF_UNSPEC
    ) -> list[ResolveResult]:
        """The host's addresses. Raises OSError if there are none."""
        loop = asyncio.get_running_loop()
        found: asyncio.Future[list[ResolveResult]] = loop.create_future()

        def look_up() -> None:
            try:
                answer: list[ResolveResult] | OSError = _addresses(host, port, family)
            except (OSError, UnicodeError) as error:
                answer = error if isinstance(error, OSError) else OSError(f"{host!r} is not a host name")
            try:
                loop.call_soon_threadsafe(_set_answer, found, answer)
            except RuntimeError:  # the loop is closed: nothing waits any more
                return

        threading.Thread(target=look_up, name=f"resolve {host}", daemon=True).start()
        return await found

    async def close(self) -> None:
        """There is nothing to close."""


def _addresses(host: str, port: int, family: socket.AddressFamily) -> list[ResolveResult]:
    return [
        ResolveResult(
            hostname=host, host=str(address[0]), port=port, family=kind, proto=protocol, flags=socket.AI_NUMERICHOST
        )
        for kind, _, protocol, _, address in socket.getaddrinfo(host, port, family, socket.SOCK_STREAM)
    ]


def _set_answer(found: asyncio.Future[list[ResolveResult]], answer: list[ResolveResult] | OSError) -> None:
    if found.done():
        return
    if isinstance(answer, OSError):
        found.set_exception(answer)
    else:
        found.set_result(answer)
