"""Creates certificates for the webhook, where there is no cert-manager.

A new authority signs one certificate and is forgotten: its key is kept nowhere, so nothing else can be signed with it.
"""

from __future__ import annotations

import datetime
import ipaddress
import secrets
from collections.abc import Mapping, Sequence
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from wayside.kubernetes.connection import ConfigurationError
from wayside.process.servingcertificate import CERTIFICATE, KEY

AUTHORITY = "ca.crt"
VALID = datetime.timedelta(days=365)
_CLOCKS = datetime.timedelta(hours=1)  # that the clocks of two machines may differ


def make_certificates(folder: Path, hosts: Sequence[str]) -> bytes:
    """Write ca.crt, tls.crt and tls.key for the hosts, names or addresses, into the folder; the first one's content.

    Raises ConfigurationError where the folder cannot be written to.
    """
    files = issued(hosts)
    write_whole(folder, files)
    return files[AUTHORITY]


def write_whole(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write the files whole or not at all. Raises ConfigurationError where the folder cannot be written to."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            if (folder / name).is_file() and (folder / name).read_bytes() == content:
                continue
            new = folder / f".{name}"
            new.unlink(missing_ok=True)
            new.touch(mode=0o600)
            new.write_bytes(content)
            new.replace(folder / name)
    except OSError as error:
        reason = error.strerror or error
        raise ConfigurationError(f"{folder}: {reason}: give a writable folder") from error


def issued(hosts: Sequence[str], valid: datetime.timedelta = VALID) -> dict[str, bytes]:
    """A new authority's certificate, and one that it signed for the hosts, with its key: contents, by file name."""
    authority, key = ec.generate_private_key(ec.SECP256R1()), ec.generate_private_key(ec.SECP256R1())
    # Of two authorities with the same name, OpenSSL tries one alone.
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
