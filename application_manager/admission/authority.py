"""Certificates of our own making, for trying the webhook where there is no cert-manager.

A new authority signs one certificate and is forgotten: its key is kept nowhere, so nothing else can be signed with it.
"""

from __future__ import annotations

import datetime
import ipaddress
from collections.abc import Sequence
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from application_manager.admission.certificate import CERTIFICATE, KEY
from application_manager.cluster.connection import ConfigurationError

AUTHORITY = "ca.crt"
VALID = datetime.timedelta(days=365)
_CLOCKS = datetime.timedelta(hours=1)  # that the clocks of two machines may differ


def make_certificates(folder: Path, hosts: Sequence[str]) -> bytes:
    """Write ca.crt, tls.crt and tls.key for the hosts, names or addresses, into the folder; the first one's content.

    Raises ConfigurationError where the folder cannot be written to.
    """
    files = _made(hosts)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            new = folder / f".{name}"
            new.unlink(missing_ok=True)
            new.touch(mode=0o600)
            new.write_bytes(content)
            new.replace(folder / name)
    except OSError as error:
        reason = error.strerror or error
        raise ConfigurationError(f"{folder}: {reason}: give a folder that can be written to") from error
    return files[AUTHORITY]


def _made(hosts: Sequence[str]) -> dict[str, bytes]:
    """The files' contents, by name."""
    authority, key = ec.generate_private_key(ec.SECP256R1()), ec.generate_private_key(ec.SECP256R1())
    issuer = _named("wayside-admission-authority")
    root = (
        _begun(issuer, authority.public_key(), issuer)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(authority, hashes.SHA256())
    )
    certificate = (
        _begun(_named("wayside-admission"), key.public_key(), issuer)
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


def _begun(subject: x509.Name, key: ec.EllipticCurvePublicKey, issuer: x509.Name) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCKS)
        .not_valid_after(now + VALID)
    )


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _host(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)
