"""Access to a network: TLS and credentials. A resource never contains secrets, only references to them.

In a cluster, they come from a mounted Secret; outside a cluster, from files or environment variables.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from wayside.api.base import Model, ObjectName, validations

FilePath = Annotated[str, Field(min_length=1, max_length=1024)]
"""A path as the detector sees it."""

Variable = Annotated[str, Field(min_length=1, max_length=255, pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
"""The name of an environment variable."""

_BOTH = "give both certificate and key, or neither"
_ONE = "give exactly one of passwordVariable and passwordFile"


class Tls(Model):
    """TLS files in PEM format. With all three, both sides authenticate (mTLS)."""

    model_config = validations(("has(self.certificate) == has(self.key)", _BOTH, ".certificate"))

    ca: FilePath | None = None
    """The path of the CA certificates that verify the certificate of the other side. Default: the public CAs."""
    certificate: FilePath | None = None
    """The path of the detector's own certificate. Requires key."""
    key: FilePath | None = None
    """The path of the private key of the certificate. Requires certificate."""
    verify_name: bool = True
    """If true, the certificate of the other side must match the host name of the endpoint."""

    @model_validator(mode="after")
    def _coherent(self) -> Tls:
        if (self.certificate is None) != (self.key is None):
            raise ValueError(_BOTH)
        return self


class Credentials(Model):
    """A username, and the source of its password."""

    model_config = validations(("has(self.passwordVariable) != has(self.passwordFile)", _ONE))

    username: str = Field(min_length=1, max_length=255)
    """The username of the detector."""
    password_variable: Variable | None = None
    """The environment variable that contains the password."""
    password_file: FilePath | None = None
    """The file that contains the password. A trailing newline is ignored."""

    @model_validator(mode="after")
    def _coherent(self) -> Credentials:
        if (self.password_variable is None) == (self.password_file is None):
            raise ValueError(_ONE)
        return self


_TLS_ONCE = "give tls or tlsSecretName, not both"
_CREDENTIALS_ONCE = "give credentials or credentialsSecretName, not both"

ACCESS_VALIDATIONS = (
    ("!(has(self.tls) && has(self.tlsSecretName))", _TLS_ONCE, ".tlsSecretName", "Forbidden"),
    (
        "!(has(self.credentials) && has(self.credentialsSecretName))",
        _CREDENTIALS_ONCE,
        ".credentialsSecretName",
        "Forbidden",
    ),
)
"""For the CRD: what `Access` checks."""


class Access(Model):
    """TLS and credentials, each by files or by a Secret."""

    tls: Tls | None = None
    """TLS certificates from files."""
    tls_secret_name: ObjectName | None = None
    """A Secret with the keys ca.crt and, if the detector authenticates with a certificate, tls.crt and tls.key."""
    credentials: Credentials | None = None
    """A username, and the source of its password."""
    credentials_secret_name: ObjectName | None = None
    """A Secret with the keys username and password."""

    @model_validator(mode="after")
    def _given_once(self) -> Access:
        if self.tls is not None and self.tls_secret_name is not None:
            raise ValueError(_TLS_ONCE)
        if self.credentials is not None and self.credentials_secret_name is not None:
            raise ValueError(_CREDENTIALS_ONCE)
        return self
