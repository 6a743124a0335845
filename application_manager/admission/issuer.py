"""Issues the webhook's certificate, if configured: creates it, stores it in a Secret, and renews it in time.

All managers of a release share the Secret. A manager that finds the certificate missing or due writes a new one; the
resourceVersion decides between two writers. The previous CA stays in `ca.crt` beside the new one, and the API server
trusts both before any manager uses the new certificate, so no review fails during the change. A new CA signs one
certificate. Its key is stored nowhere, so nothing else can be signed with it.
"""

from __future__ import annotations

import asyncio
import base64
import datetime
import ipaddress
import logging
import secrets
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from application_manager.admission.webhook import WebhookOptions
from application_manager.core.findings.webhooks import WebhookClientConfig
from wayside.kubernetes.client import Client
from wayside.kubernetes.connection import ConfigurationError
from wayside.kubernetes.errors import ApiError
from wayside.kubernetes.resources import Object, Resource
from wayside.kubernetes.retrying import repeatedly, until_answered
from wayside.process.files import replace_file
from wayside.process.servingcertificate import CERTIFICATE, KEY

EVERY = 10.0  # s between two checks of the Secret
_RENEWED_AT = 1 / 3  # of the lifetime that remains

AUTHORITY = "ca.crt"
VALID = datetime.timedelta(days=365)
_CLOCKS = datetime.timedelta(hours=1)  # the tolerated difference between the clocks of two machines

_SECRETS = Resource("v1", "Secret", "secrets")
_GROUP = "admissionregistration.k8s.io/v1"
_CONFIGURATIONS = (
    Resource(_GROUP, "ValidatingWebhookConfiguration", "validatingwebhookconfigurations", namespaced=False),
    Resource(_GROUP, "MutatingWebhookConfiguration", "mutatingwebhookconfigurations", namespaced=False),
)

log = logging.getLogger(__name__)


async def renew(client: Client, options: WebhookOptions) -> None:
    """Create a certificate if it is due, write the CA into the webhooks, and write the files as they are in the Secret.

    `client` also writes while this manager is not the active one. Raises ConfigurationError if the Secret does not
    exist.
    """
    namespace, name = options.secret
    secret = await client.get(_SECRETS, namespace, name)
    if secret is None:
        raise ConfigurationError(f"Secret {namespace}/{name} for the webhook's certificate does not exist: create it")
    files = {key: base64.b64decode(value) for key, value in (secret.get("data") or {}).items()}
    if _due(files, now := datetime.datetime.now(datetime.UTC)):
        files = issued(WebhookClientConfig.of_service(options.service).hosts)
        files[AUTHORITY] += _trusted(secret, now)
        data = {key: base64.b64encode(content).decode() for key, content in files.items()}
        try:
            await client.replace(_SECRETS, secret | {"data": data})
        except ApiError as error:
            if error.code == 409:  # another manager was first
                return await renew(client, options)
            raise
        log.info("created a certificate for the webhook, valid for %d days", VALID.days)
    await _trust(client, options.webhooks, base64.b64encode(files[AUTHORITY]).decode())
    write_whole(options.certificates, {each: files[each] for each in (AUTHORITY, CERTIFICATE, KEY)})


async def _trust(client: Client, name: str, bundle: str) -> None:
    """Write the CA into the existing webhook configurations of this name."""
    for resource in _CONFIGURATIONS:
        found: Object | None = await client.get(resource, "", name)
        if found is None:
            continue
        webhooks: list[Any] = found.get("webhooks") or []
        if any(each["clientConfig"].get("caBundle") != bundle for each in webhooks):
            changed = [{"name": each["name"], "clientConfig": {"caBundle": bundle}} for each in webhooks]
            await client.merge_members(resource, name, {"webhooks": changed})
            log.info("wrote the CA of the webhook's certificate into the %s", resource.kind)


def _due(files: dict[str, bytes], now: datetime.datetime) -> bool:
    """Whether there is no certificate, or too little of its lifetime remains."""
    if not all(files.get(each) for each in (AUTHORITY, CERTIFICATE, KEY)):
        return True
    try:
        certificate = x509.load_pem_x509_certificate(files[CERTIFICATE])
    except ValueError:
        return True
    life = certificate.not_valid_after_utc - certificate.not_valid_before_utc
    return certificate.not_valid_after_utc - now < life * _RENEWED_AT


def _trusted(secret: Object, now: datetime.datetime) -> bytes:
    """The CA of the current certificate, if that is still valid."""
    bundle = base64.b64decode((secret.get("data") or {}).get(AUTHORITY, ""))
    try:
        newest = x509.load_pem_x509_certificates(bundle)[0]
    except (ValueError, IndexError):
        return b""
    return newest.public_bytes(serialization.Encoding.PEM) if newest.not_valid_after_utc > now else b""


@asynccontextmanager
async def issuing(client: Client, options: WebhookOptions | None) -> AsyncIterator[None]:
    """Keep the webhook's certificate valid while the block runs, if the manager issues it.

    First it waits for a certificate, as long as the API server takes to respond. Raises ConfigurationError if the
    Secret does not exist, and ApiError if the API server refuses permanently.
    """
    if options is None or not options.service:
        yield
        return
    attempt = partial(renew, client, options)
    await until_answered(attempt)
    renewing = repeatedly(attempt, EVERY, "cannot renew the webhook's certificate")
    following = asyncio.create_task(renewing, name="issuing")
    try:
        yield
    finally:
        following.cancel()
        await asyncio.gather(following, return_exceptions=True)


def make_certificates(folder: Path, hosts: Sequence[str]) -> bytes:
    """Write ca.crt, tls.crt and tls.key for the hosts (names or addresses) into the folder; returns ca.crt.

    Raises ConfigurationError if the folder is not writable.
    """
    files = issued(hosts)
    write_whole(folder, files)
    return files[AUTHORITY]


def write_whole(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write the files atomically. Raises ConfigurationError if the folder is not writable."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            path = folder / name
            if not path.is_file() or path.read_bytes() != content:
                replace_file(path, content, private=True)
    except OSError as error:
        reason = error.strerror or error
        raise ConfigurationError(f"{folder}: {reason}: give a writable folder") from error


def issued(hosts: Sequence[str], valid: datetime.timedelta = VALID) -> dict[str, bytes]:
    """A new CA certificate, and a certificate with key that it signed for the hosts: contents, by file name."""
    authority, key = ec.generate_private_key(ec.SECP256R1()), ec.generate_private_key(ec.SECP256R1())
    # Of two CAs with the same name, OpenSSL tries only one.
    issuer = _named(f"wayside-admission-authority-{secrets.token_hex(4)}")
    root = (
        _begun(issuer, authority.public_key(), issuer, valid)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(authority, hashes.SHA256())
    )
    certificate = (
        _begun(_named("wayside-admission"), key.public_key(), issuer, valid)
        .add_extension(x509.SubjectAlternativeName([_host(each) for each in hosts]), critical=False)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .sign(authority, hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    return {
        AUTHORITY: root.public_bytes(pem),
        CERTIFICATE: certificate.public_bytes(pem),
        KEY: key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()),
    }


def _begun(
    subject: x509.Name, key: ec.EllipticCurvePublicKey, issuer: x509.Name, valid: datetime.timedelta
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCKS)
        .not_valid_after(now + valid)
    )


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _host(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)
