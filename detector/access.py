"""Certificates and credentials in the form that programs need: files and texts. They are read for each connection.

A Secret is a folder with its name, in the folder named by the environment variable `WAYSIDE_SECRETS` (default:
/etc/wayside/secrets), with one file per key, as Kubernetes mounts it.

The files of a network may change at any time, one after the other. So `read_credentials` reads them, tests them as a
pair, and reads them again: the result is consistent, and does not change while a session uses it.
"""

from __future__ import annotations

import datetime
import os
import ssl
from dataclasses import dataclass, field
from pathlib import Path

from wayside.api.access import Access
from wayside.api.database import DatabaseConnection

SECRETS_VARIABLE = "WAYSIDE_SECRETS"
SECRETS_FOLDER = "/etc/wayside/secrets"


class AccessError(ValueError):
    """A certificate or password that is not at the configured place; the message names the field, never a secret."""


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """Existing PEM files."""

    ca: Path | None
    certificate: Path | None
    key: Path | None
    verify_name: bool

    def context(self) -> ssl.SSLContext:
        """Of a client with these files. Raises ssl.SSLError or OSError if one is not in PEM format."""
        context = ssl.create_default_context(cafile=self.ca)
        context.check_hostname = self.verify_name
        if self.certificate is not None:
            context.load_cert_chain(self.certificate, self.key)
        return context


@dataclass(frozen=True, slots=True)
class Login:
    """A username and its password."""

    username: str
    password: str

    def __repr__(self) -> str:
        return f"Login({self.username!r})"


def tls_files(access: Access, field: str) -> TlsFiles | None:
    """The files for TLS, None if none are configured; `field` is the place of `access`. Raises AccessError."""
    if access.tls is not None:
        tls = access.tls
        return TlsFiles(
            _file(tls.ca, f"{field}.tls.ca"),
            _file(tls.certificate, f"{field}.tls.certificate"),
            _file(tls.key, f"{field}.tls.key"),
            tls.verify_name,
        )
    if access.tls_secret_name is None:
        return None
    at = f"{field}.tlsSecretName"
    folder = _secret(access.tls_secret_name, at)
    own = (folder / "tls.crt").exists()
    return TlsFiles(
        _file(folder / "ca.crt", at),
        _file(folder / "tls.crt", at) if own else None,
        _file(folder / "tls.key", at) if own else None,
        verify_name=True,
    )


def login(access: Access, field: str) -> Login | None:
    """The credentials, None if none are configured; `field` is the place of `access`. Raises AccessError."""
    given = access.credentials
    if given is not None:
        if given.password_file is not None:
            return Login(given.username, _text(Path(given.password_file), f"{field}.credentials.passwordFile"))
        return Login(given.username, variable_text(given.password_variable, f"{field}.credentials.passwordVariable"))
    if access.credentials_secret_name is None:
        return None
    at = f"{field}.credentialsSecretName"
    folder = _secret(access.credentials_secret_name, at)
    return Login(_text(folder / "username", at), _text(folder / "password", at))


def secret_text(name: str, key: str, field: str) -> str:
    """The value of a Secret's key, without a trailing newline. Raises AccessError."""
    return _text(_secret(name, field) / key, field)


def variable_text(name: str | None, field: str) -> str:
    """The value of an environment variable, which `field` names. Raises AccessError."""
    value = os.environ.get(name or "")
    if value is None:
        raise AccessError(f"{field}: the environment variable {name} is not set: set it")
    return value


def database_uri(database: DatabaseConnection, field: str) -> str:
    """The connection string of a database; `field` is the place of `database`. Raises AccessError."""
    if database.uri_file is not None:
        return _text(Path(database.uri_file), f"{field}.uriFile")
    if database.uri_secret_name is not None:
        return secret_text(database.uri_secret_name, "uri", f"{field}.uriSecretName")
    return variable_text(database.uri_variable, f"{field}.uriVariable")


def _secret(name: str, field: str) -> Path:
    folder = Path(os.environ.get(SECRETS_VARIABLE, SECRETS_FOLDER)) / name
    if not folder.is_dir():
        raise AccessError(f"{field}: the Secret {name} is not mounted at {folder}: mount it, or set {SECRETS_VARIABLE}")
    return folder


def _file(path: str | Path | None, field: str) -> Path | None:
    if path is None:
        return None
    try:
        with Path(path).open("rb"):
            return Path(path)
    except OSError as error:
        raise _unreadable(Path(path), field, error) from error


def _text(path: Path, field: str) -> str:
    try:
        return path.read_text(encoding="utf-8").removesuffix("\n")
    except UnicodeDecodeError as error:
        raise AccessError(f"{field}: {path} is not UTF-8 text: rewrite the file as UTF-8") from error
    except OSError as error:
        raise _unreadable(path, field, error) from error


def _unreadable(path: Path, field: str, error: OSError) -> AccessError:
    reason = error.strerror or type(error).__name__
    return AccessError(f"{field}: cannot read {path}: {reason}: create the file, or correct the field")


_ATTEMPTS = 5
"""Number of attempts to read files that change during the read."""


@dataclass(frozen=True, slots=True)
class LoadedCredentials:
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


def read_credentials(access: Access, at: str) -> LoadedCredentials:
    """The current credentials of `access`, which is in the field `at`. Raises AccessError if it cannot be used."""
    files, credentials = tls_files(access, at), login(access, at)
    if files is None:
        return LoadedCredentials(login=credentials)
    for _ in range(_ATTEMPTS):
        before = _read(files)
        problem = _problem(files)
        if before != _read(files):
            continue
        if problem is not None:
            raise AccessError(f"{at}: {problem}")
        ca, certificate, key = before
        return LoadedCredentials(ca, certificate, key, files.verify_name, credentials, tls=True)
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
