"""The detector's certificates, key and password for a network, read as one consistent set.

The files may change at any time, one after the other. So they are read, tested as a pair, and read again: the result is
consistent, and does not change while a session uses it.
"""

from __future__ import annotations

import datetime
import ssl
from dataclasses import dataclass, field
from pathlib import Path

from detector.access.mounted import AccessError, Login, TlsFiles, login, tls_files
from wayside.api.access import Access

_ATTEMPTS = 5
"""Number of attempts to read files that change during the read."""


@dataclass(frozen=True, slots=True)
class Material:
    """PEM texts and a login, read together. None if absent."""

    ca: bytes | None = field(default=None, repr=False)
    certificate: bytes | None = field(default=None, repr=False)
    key: bytes | None = field(default=None, repr=False)
    verify_name: bool = True
    login: Login | None = None
    tls: bool = False

    @property
    def expires(self) -> float | None:
        """When the first certificate of the detector's own chain expires, in seconds since the epoch."""
        return None if self.certificate is None else expiry(self.certificate)


def read_material(access: Access, at: str) -> Material:
    """The current material of `access`, which is in the field `at`. Raises AccessError if it cannot be used."""
    files, credentials = tls_files(access, at), login(access, at)
    if files is None:
        return Material(login=credentials)
    for _ in range(_ATTEMPTS):
        before = _read(files)
        problem = _problem(files)
        if before != _read(files):
            continue
        if problem is not None:
            raise AccessError(f"{at}: {problem}")
        ca, certificate, key = before
        return Material(ca, certificate, key, files.verify_name, credentials, tls=True)
    raise AccessError(f"{at}: {files.certificate or files.ca} keeps changing while it is read; reading it again later")


def expiry(pem: bytes) -> float:
    """When the first of the certificates expires, in seconds since the epoch. Raises ValueError if there is none."""
    from cryptography import x509  # noqa: PLC0415  most detectors have no certificate and save its memory

    return min(each.not_valid_after_utc for each in x509.load_pem_x509_certificates(pem)).timestamp()


def _read(files: TlsFiles) -> tuple[bytes | None, bytes | None, bytes | None]:
    ca, certificate, key = (_content(path) for path in (files.ca, files.certificate, files.key))
    return ca, certificate, key


def _content(path: Path | None) -> bytes | None:
    try:
        return None if path is None else path.read_bytes()
    except OSError:  # being replaced: the next attempt decides
        return None


def _problem(files: TlsFiles) -> str | None:
    """The problem of the files, without any of their content."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        if files.ca is not None:
            context.load_verify_locations(files.ca)
    except (OSError, ssl.SSLError) as error:
        return f"{files.ca} contains no readable certificates ({_reason(error)}): give PEM"
    if files.certificate is None or files.key is None:
        return None
    try:
        context.load_cert_chain(files.certificate, files.key)
        expires = expiry(files.certificate.read_bytes())
    except (OSError, ssl.SSLError, ValueError) as error:
        if "KEY_VALUES_MISMATCH" in str(error):
            return f"{files.key} is not the key of {files.certificate}: give a certificate and its own key"
        return f"{files.certificate} and {files.key} are not a certificate and a key ({_reason(error)}): give PEM"
    now = datetime.datetime.now(datetime.UTC).timestamp()
    return f"{files.certificate} expired {now - expires:.0f} s ago: renew it" if expires <= now else None


def _reason(error: Exception) -> str:
    return getattr(error, "reason", None) or getattr(error, "strerror", None) or type(error).__name__
