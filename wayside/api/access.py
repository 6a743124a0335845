"""How a network is entered: TLS and credentials. Secrets themselves never stand in a resource, only where they are.

In a cluster they come from a Secret that is mounted for the detector; beside one, from files or the environment.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from wayside.api.base import Model, ObjectName, validations

FilePath = Annotated[str, Field(min_length=1, max_length=1024)]
"""A path as the detector sees it."""

Variable = Annotated[str, Field(min_length=1, max_length=255, pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
"""The name of an environment variable."""

_BOTH = "certificate and key belong together: give both or neither"
_ONE = "give the password's place once: passwordVariable or passwordFile"


class Tls(Model):
    """Files in PEM format. With all three, each side proves who it is (mTLS)."""

    model_config = validations(("has(self.certificate) == has(self.key)", _BOTH))

    ca: FilePath | None = Field(
        default=None,
        description="The certificates of the authorities that the other side's certificate is checked against. "
        "Default: those of public authorities.",
    )
    certificate: FilePath | None = Field(default=None, description="The detector's own certificate.")
    key: FilePath | None = Field(default=None, description="The private key of the certificate.")
    verify_name: bool = Field(
        default=True, description="Whether the other side's certificate must be for the name in the endpoint."
    )

    @model_validator(mode="after")
    def _coherent(self) -> Tls:
        if (self.certificate is None) != (self.key is None):
            raise ValueError(_BOTH)
        return self


class Credentials(Model):
    """A username, and where the password is."""

    model_config = validations(("has(self.passwordVariable) != has(self.passwordFile)", _ONE))

    username: str = Field(min_length=1, max_length=255, description="Who the detector is.")
    password_variable: Variable | None = Field(
        default=None, description="The environment variable that holds the password."
    )
    password_file: FilePath | None = Field(
        default=None, description="The file that holds the password; a newline at its end does not count."
    )

    @model_validator(mode="after")
    def _coherent(self) -> Credentials:
        if (self.password_variable is None) == (self.password_file is None):
            raise ValueError(_ONE)
        return self


_TLS_ONCE = "give tls or tlsSecret, not both"
_CREDENTIALS_ONCE = "give credentials or credentialsSecret, not both"

ACCESS_VALIDATIONS = (
    ("!(has(self.tls) && has(self.tlsSecret))", _TLS_ONCE),
    ("!(has(self.credentials) && has(self.credentialsSecret))", _CREDENTIALS_ONCE),
)
"""For the CRD: what `Access` checks."""


class Access(Model):
    """TLS and credentials, each by files or by a Secret."""

    tls: Tls | None = Field(default=None, description="Certificates in files.")
    tls_secret: ObjectName | None = Field(
        default=None,
        description="A Secret with ca.crt and, where the detector proves who it is, tls.crt and tls.key.",
    )
    credentials: Credentials | None = Field(default=None, description="A username, and where its password is.")
    credentials_secret: ObjectName | None = Field(default=None, description="A Secret with username and password.")

    @model_validator(mode="after")
    def _given_once(self) -> Access:
        if self.tls is not None and self.tls_secret is not None:
            raise ValueError(_TLS_ONCE)
        if self.credentials is not None and self.credentials_secret is not None:
            raise ValueError(_CREDENTIALS_ONCE)
        return self
