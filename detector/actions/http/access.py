"""Headers and certificates of a request, read for each request: a renewed Secret takes effect at once."""

from __future__ import annotations

import base64
import os
import ssl
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from detector.access.mounted import AccessError, TlsFiles, login, secret_text, tls_files, variable_text
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
