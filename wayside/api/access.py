"""Access to a network: TLS and credentials. A resource never contains secrets, only references to them.

In a cluster, they come from a mounted Secret; outside a cluster, from files or environment variables.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from wayside.api.base import Model, SubdomainName
from wayside.api.constraints import Constraint, constraint, exactly_one, not_both

FilePath = Annotated[str, Field(min_length=1, max_length=1024)]
"""A path as the detector sees it."""

Variable = Annotated[str, Field(min_length=1, max_length=255, pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
"""The name of an environment variable."""


class Tls(Model):
    """TLS files in PEM format. With all three, both sides authenticate (mTLS)."""

    constraints = (
        constraint(
            "has(self.certificate) == has(self.key)",
            "give both certificate and key, or neither",
            ".certificate",
            holds=lambda tls: (tls.certificate is None) == (tls.key is None),
        ),
    )

    ca: FilePath | None = None
    """The path of the CA certificates that verify the certificate of the other side. Default: the public CAs."""
    certificate: FilePath | None = None
    """The path of the detector's own certificate. Requires key."""
    key: FilePath | None = None
    """The path of the private key of the certificate. Requires certificate."""
    verify_name: bool = True
    """If true, the certificate of the other side must match the host name of the endpoint."""


class Credentials(Model):
    """A username, and the source of its password."""

    constraints = (exactly_one("password_variable", "password_file"),)

    username: str = Field(min_length=1, max_length=255)
    """The username of the detector."""
    password_variable: Variable | None = None
    """The environment variable that contains the password."""
    password_file: FilePath | None = None
    """The file that contains the password. A trailing newline is ignored."""


class Access(Model):
    """TLS and credentials, each by files or by a Secret."""

    constraints: ClassVar[tuple[Constraint, ...]] = (
        not_both("tls", "tls_secret_name"),
        not_both("credentials", "credentials_secret_name"),
    )

    tls: Tls | None = None
    """TLS certificates from files."""
    tls_secret_name: SubdomainName | None = None
    """A Secret with the keys ca.crt and, if the detector authenticates with a certificate, tls.crt and tls.key."""
    credentials: Credentials | None = None
    """A username, and the source of its password."""
    credentials_secret_name: SubdomainName | None = None
    """A Secret with the keys username and password."""
