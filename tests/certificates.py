"""Certificates for tests: an authority and the certificates that it signs."""

from __future__ import annotations

import datetime
import ipaddress
import tempfile
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

_DAY = datetime.timedelta(days=1)


class Authority:
    """Signs certificates for localhost."""

    def __init__(self, folder: Path, name: str = "authority") -> None:
        self._folder = folder
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        self.ca = folder / f"{name}.crt"
        certificate = self._builder(self._name, self._key.public_key()).add_extension(
            x509.BasicConstraints(ca=True, path_length=None), critical=True
        )
        self.ca.write_bytes(certificate.sign(self._key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM))

    def sign(
        self, name: str, host: str = "localhost", lasting: datetime.timedelta = _DAY, folder: Path | None = None
    ) -> tuple[Path, Path]:
        """The files of a certificate and its key, for a host and 127.0.0.1, for clients and servers."""
        key = ec.generate_private_key(ec.SECP256R1())
        builder = (
            self._builder(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)]), key.public_key(), lasting)
            .add_extension(
                x509.SubjectAlternativeName([x509.DNSName(host), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]),
                critical=False,
            )
            .add_extension(
                x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]),
                critical=False,
            )
        )
        where = folder or self._folder
        files = where / f"{name}.crt", where / f"{name}.key"
        files[0].write_bytes(builder.sign(self._key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM))
        files[1].write_bytes(
            key.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
            )
        )
        return files

    def mount(self, volume: Path, name: str, lasting: datetime.timedelta = _DAY) -> None:
        """Write a new certificate as a mounted Secret: the kubelet replaces all files atomically."""
        self.change(volume, dict(zip(("tls.crt", "tls.key"), self._signed(name, lasting), strict=True)))

    def change(self, volume: Path, files: dict[str, bytes]) -> None:
        """Replace the content of a mounted Secret by these files and the authority's."""
        new = volume / f"..{x509.random_serial_number()}"
        new.mkdir(parents=True)
        for each, content in ({"ca.crt": self.ca.read_bytes()} | files).items():
            (new / each).write_bytes(content)
            if not (volume / each).is_symlink():
                (volume / each).symlink_to(f"..data/{each}")
        link = volume / "..data_tmp"
        link.symlink_to(new.name)
        link.rename(volume / "..data")

    def _signed(self, name: str, lasting: datetime.timedelta) -> tuple[bytes, bytes]:
        with tempfile.TemporaryDirectory() as folder:
            certificate, key = self.sign(name, lasting=lasting, folder=Path(folder))
            return certificate.read_bytes(), key.read_bytes()

    def _builder(
        self, subject: x509.Name, key: ec.EllipticCurvePublicKey, lasting: datetime.timedelta = _DAY
    ) -> x509.CertificateBuilder:
        now = datetime.datetime.now(datetime.UTC)
        return (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(self._name)
            .public_key(key)
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - _DAY)
            .not_valid_after(now + lasting)
        )
