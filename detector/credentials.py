"""What the detector proves itself with on a network, as one whole: certificates, key and password of one moment.

The files may change at any time, one after the other. So they are read, tried as a pair, and read again: what is given
on belongs together, and stays what it is while a session uses it.
"""

from __future__ import annotations

import datetime
import re
import ssl
from dataclasses import dataclass, field
from pathlib import Path

from detector.access import AccessError, Login, TlsFiles, login, tls_files
from wayside.api.access import Access

_ATTEMPTS = 5
"""So often files that change while they are read are read again."""

_CERTIFICATE = re.compile(rb"-----BEGIN CERTIFICATE-----.+?-----END CERTIFICATE-----", re.DOTALL)

_SEQUENCE, _VERSION, _UTC_TIME, _GENERALIZED_TIME = 0x30, 0xA0, 0x17, 0x18


@dataclass(frozen=True, slots=True)
class Material:
    """PEM texts and a login, of one moment. None where there is none."""

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
    """What `access`, which stands at the field `at`, means now. Raises AccessError for what cannot be used."""
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
    raise AccessError(f"{at}: {files.certificate or files.ca} changes all the time: it is looked at again")


def expiry(pem: bytes) -> float:
    """When the first of the certificates expires, in seconds since the epoch. Raises ValueError where there is none."""
    ends = [_not_after(ssl.PEM_cert_to_DER_cert(each.decode("ascii"))) for each in _CERTIFICATE.findall(pem)]
    if not ends:
        raise ValueError("there is no PEM certificate")
    return min(ends)


def _read(files: TlsFiles) -> tuple[bytes | None, bytes | None, bytes | None]:
    ca, certificate, key = (_content(path) for path in (files.ca, files.certificate, files.key))
    return ca, certificate, key


def _content(path: Path | None) -> bytes | None:
    try:
        return None if path is None else path.read_bytes()
    except OSError:  # replaced just now: the next attempt tells
        return None


def _problem(files: TlsFiles) -> str | None:
    """What is wrong with the files, in words without any of their content."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        if files.ca is not None:
            context.load_verify_locations(files.ca)
    except (OSError, ssl.SSLError) as error:
        return f"{files.ca} holds no certificates that can be read ({_reason(error)}): give PEM"
    if files.certificate is None or files.key is None:
        return None
    try:
        context.load_cert_chain(files.certificate, files.key)
        expires = expiry(files.certificate.read_bytes())
    except (OSError, ssl.SSLError, ValueError) as error:
        if "KEY_VALUES_MISMATCH" in str(error):
            return f"{files.key} is not the key of {files.certificate}: give both of one pair"
        return f"{files.certificate} and {files.key} are no certificate and key ({_reason(error)}): give PEM"
    now = datetime.datetime.now(datetime.UTC).timestamp()
    return f"{files.certificate} expired {now - expires:.0f} s ago: renew it" if expires <= now else None


def _reason(error: Exception) -> str:
    return getattr(error, "reason", None) or getattr(error, "strerror", None) or type(error).__name__


def _not_after(der: bytes) -> float:
    """Certificate, TBSCertificate, validity, notAfter: RFC 5280, section 4.1. Raises ValueError."""
    fields = _elements(_first(_first(der)))
    if fields and fields[0][0] == _VERSION:
        fields.pop(0)
    if len(fields) < 4 or fields[3][0] != _SEQUENCE:  # serial number, signature, issuer, validity
        raise ValueError("it is no X.509 certificate")
    times = _elements(fields[3][1])
    if len(times) != 2:
        raise ValueError("its validity is not two times")
    tag, text = times[1][0], times[1][1].decode("ascii")
    if tag == _UTC_TIME:
        text = ("19" if text[:2] >= "50" else "20") + text
    elif tag != _GENERALIZED_TIME:
        raise ValueError("its end is no time")
    return datetime.datetime.strptime(text, "%Y%m%d%H%M%SZ").replace(tzinfo=datetime.UTC).timestamp()


def _first(der: bytes) -> bytes:
    """The content of the first element. Raises ValueError."""
    elements = _elements(der)
    if not elements:
        raise ValueError("it is no X.509 certificate")
    return elements[0][1]


def _elements(der: bytes) -> list[tuple[int, bytes]]:
    """Tag and content of each element. Raises ValueError."""
    at, found = 0, []
    while at < len(der):
        if at + 2 > len(der):
            raise ValueError("it ends too early")
        tag, length, at = der[at], der[at + 1], at + 2
        if length & 0x80:
            size = length & 0x7F
            length, at = int.from_bytes(der[at : at + size]), at + size
        if at + length > len(der):
            raise ValueError("it ends too early")
        found.append((tag, der[at : at + length]))
        at += length
    return found
