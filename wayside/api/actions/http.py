"""Access of actions to HTTP endpoints: headers, TLS and credentials. A rule never contains secrets.

The people who write rules are often not those who run the detector. So a rule can use only mounted Secrets that the
Detector does not keep for its own use, and environment variables whose names begin with WAYSIDE_.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import ConfigDict, Field, model_validator

from wayside.api.access import Access, Tls
from wayside.api.base import ATOMIC_MAP, Model, PositiveDuration, SubdomainName, map_list
from wayside.api.constraints import Constraint, exactly_one, not_both

_VARIABLE = r"^WAYSIDE_[A-Z0-9_]+$"
_TOKEN = r"^[A-Za-z0-9!#$%&'*+.^_`|~-]+$"  # noqa: S105  RFC 9110, section 5.6.2: the characters of a header's name
_OURS = ("host", "content-length", "content-type", "transfer-encoding", "connection", "expect", "te", "upgrade")

HttpUrl = Annotated[str, Field(max_length=2048, pattern=r"^https?://[^\s/?#@\\]+([/?][^\s#]*)?$")]
"""The URL of a request."""


class SecretKey(Model):
    """A key of a Secret that is mounted for the detector."""

    model_config = ConfigDict(json_schema_extra=ATOMIC_MAP)

    name: SubdomainName
    """The name of the Secret."""
    key: str = Field(min_length=1, max_length=253, pattern=r"^[A-Za-z0-9_-][A-Za-z0-9._-]*$")
    """The key in the Secret."""


class HttpHeader(Model):
    """A header of each request, with its value or the source of its value."""

    constraints = (exactly_one("value", "variable", "secret_key_ref"),)

    name: str = Field(min_length=1, max_length=128, pattern=_TOKEN)
    """The name of the header, e.g. Authorization."""
    value: str | None = Field(default=None, max_length=2048, pattern=r"^[^\r\n\x00]*$")
    """The literal value. Not for secrets."""
    variable: str | None = Field(default=None, max_length=255, pattern=_VARIABLE)
    """The environment variable of the detector that contains the value. Its name must begin with WAYSIDE_."""
    secret_key_ref: SecretKey | None = None
    """The Secret key that contains the value."""

    @model_validator(mode="after")
    def _coherent(self) -> HttpHeader:
        if self.name.lower() in _OURS or self.name.lower().startswith("ce-"):
            raise ValueError(f"the header {self.name} is set by the detector: remove it")
        return self


class HttpAccess(Model):
    """Access to an HTTP endpoint. Its certificate is always verified; redirects are never followed."""

    constraints: ClassVar[tuple[Constraint, ...]] = (not_both("tls", "tls_secret_name"),)

    headers: list[HttpHeader] = Field(default_factory=list, max_length=32, json_schema_extra=map_list("name"))
    """Additional headers of each request."""
    timeout: PositiveDuration = PositiveDuration("10s")
    """The total timeout of one attempt, from name resolution to the end of the response."""
    tls: Tls | None = None
    """TLS certificates from files."""
    tls_secret_name: SubdomainName | None = None
    """A Secret with the keys ca.crt and, if the detector authenticates with a certificate, tls.crt and tls.key."""
    credentials_secret_name: SubdomainName | None = None
    """A Secret with the keys username and password, for HTTP Basic authentication."""

    @model_validator(mode="after")
    def _unique_headers(self) -> HttpAccess:
        names = [header.name.lower() for header in self.headers]
        if len(set(names)) < len(names):
            raise ValueError("headers: a name is used twice (names are case-insensitive): names must be unique")
        return self

    @property
    def access(self) -> Access:
        """TLS and credentials as an `Access`, the common type for all networks."""
        return Access(
            tls=self.tls, tls_secret_name=self.tls_secret_name, credentials_secret_name=self.credentials_secret_name
        )
