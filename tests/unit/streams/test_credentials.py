"""The credentials of a session are read atomically and have a known expiry."""

from __future__ import annotations

import datetime
import ssl
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from hypothesis import given
from hypothesis import strategies as st

from detector import access as mounted_files
from detector.access import AccessError, LoadedCredentials, expiry, read_credentials
from tests.certificates import Authority
from wayside.api.access import Access

KEY = ec.generate_private_key(ec.SECP256R1())
ENDS = st.datetimes(min_value=datetime.datetime(1990, 1, 1), max_value=datetime.datetime(2200, 1, 1)).map(
    lambda time: time.replace(microsecond=0, tzinfo=datetime.UTC)
)


def certificate(until: datetime.datetime, name: str = "car", serial: int = 7) -> bytes:
    who = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    built = x509.CertificateBuilder().subject_name(who).issuer_name(who).public_key(KEY.public_key())
    built = built.serial_number(serial).not_valid_before(datetime.datetime(1980, 1, 1)).not_valid_after(until)
    return built.sign(KEY, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


@given(st.lists(ENDS, min_size=1, max_size=3), st.text("abc", min_size=1, max_size=60), st.integers(1, 2**159 - 1))
def test_a_chain_ends_with_the_first_of_its_certificates(ends: list[datetime.datetime], name: str, serial: int) -> None:
    chain = b"of the\n" + b"then\n".join(certificate(each, name, serial) for each in ends)
    assert expiry(chain) == min(each.timestamp() for each in ends)


@given(st.binary(max_size=60), st.integers(0, 300))
def test_an_invalid_certificate_is_a_value_error(noise: bytes, cut: int) -> None:
    with pytest.raises(ValueError, match="PEM"):
        expiry(noise)
    der = ssl.PEM_cert_to_DER_cert(certificate(datetime.datetime(2030, 1, 1)).decode())
    with pytest.raises(ValueError, match="asn1"):
        expiry(ssl.DER_cert_to_PEM_cert(der[: min(cut, len(der) - 1)]).encode())


def access(folder: Path) -> Access:
    paths = {
        name: str(folder / file) for name, file in (("ca", "ca.crt"), ("certificate", "tls.crt"), ("key", "tls.key"))
    }
    return Access.model_validate({"tls": paths})


def test_files_that_change_while_they_are_read_are_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kubelet exchanges the folder just after the certificate was read, before the key was."""
    authority, mounted = Authority(tmp_path), tmp_path / "own"
    authority.mount(mounted, "first")
    read, content = [], mounted_files._content

    def exchanged(path: Path | None) -> bytes | None:
        found = content(path)
        read.append(path)
        if len(read) == 2:
            authority.mount(mounted, "second")
        return found

    monkeypatch.setattr(mounted_files, "_content", exchanged)
    credentials = read_credentials(access(mounted), "spec.zenoh")
    assert credentials.certificate == (mounted / "tls.crt").read_bytes()
    assert credentials.key == (mounted / "tls.key").read_bytes()


def test_files_that_change_at_each_read_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    authority, mounted = Authority(tmp_path), tmp_path / "own"
    authority.mount(mounted, "first")
    count = iter(range(1000))
    monkeypatch.setattr(mounted_files, "_content", lambda path: str(next(count)).encode())
    with pytest.raises(AccessError, match=r"spec\.zenoh: .*tls\.crt keeps changing"):
        read_credentials(access(mounted), "spec.zenoh")


def test_the_representation_contains_no_secret() -> None:
    shown = repr(LoadedCredentials(b"ca", b"certificate", b"key", login=None, tls=True))
    assert "key" not in shown
