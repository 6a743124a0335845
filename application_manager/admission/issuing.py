"""The webhook's certificate, if the manager issues it: created, stored in a Secret, and renewed in time.

All managers of a release share the Secret. A manager that finds its certificate missing or due writes a new one; the
resourceVersion decides between two. The previous authority stays in `ca.crt` beside the new one, and the API server
trusts both before any manager shows the new certificate, so no question fails while they change.
"""

from __future__ import annotations

import asyncio
import base64
import datetime
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from application_manager.admission.authority import AUTHORITY, VALID, issued, write_whole
from application_manager.admission.reviewing import Serving
from application_manager.core.findings.webhooks import WebhookClientConfig
from wayside.kubernetes.client import Client
from wayside.kubernetes.connection import ConfigurationError
from wayside.kubernetes.errors import ApiError
from wayside.kubernetes.repeating import repeatedly, until_answered
from wayside.kubernetes.resources import Object, Resource
from wayside.process.servingcertificate import CERTIFICATE, KEY

EVERY = 10.0  # s between two looks at the Secret
_RENEWED_AT = 1 / 3  # of its life that is left

_SECRETS = Resource("v1", "Secret", "secrets")
_GROUP = "admissionregistration.k8s.io/v1"
_CONFIGURATIONS = (
    Resource(_GROUP, "ValidatingWebhookConfiguration", "validatingwebhookconfigurations", namespaced=False),
    Resource(_GROUP, "MutatingWebhookConfiguration", "mutatingwebhookconfigurations", namespaced=False),
)

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Issuing:
    """Keeps the certificate valid, the files as in the Secret, and the webhooks' authority as in it.

    Attributes:
        client: writes also while this manager is not the active one.
        service: of the webhook, as NAMESPACE/NAME.
        secret: namespace and name of the Secret, which exists.
        webhooks: the name of the webhook configurations.
        folder: for the files.
    """

    client: Client
    service: str
    secret: tuple[str, str]
    webhooks: str
    folder: Path

    async def first(self) -> None:
        """Have a certificate, however long the API server takes to answer.

        Raises ConfigurationError where the Secret does not exist, and ApiError where the API server refuses for good.
        """
        await until_answered(self.look)

    async def follow(self) -> None:
        """Look again and again, until cancelled."""
        await asyncio.sleep(EVERY)
        await repeatedly(self.look, EVERY, "cannot renew the webhook's certificate")

    async def look(self) -> None:
        """Look once: make a certificate where one is due, give the API server its authority, and write the files."""
        namespace, name = self.secret
        secret = await self.client.get(_SECRETS, namespace, name)
        if secret is None:
            raise ConfigurationError(
                f"Secret {namespace}/{name} for the webhook's certificate does not exist: create it"
            )
        files = {key: base64.b64decode(value) for key, value in (secret.get("data") or {}).items()}
        if _due(files, now := datetime.datetime.now(datetime.UTC)):
            files = issued(WebhookClientConfig.of_service(self.service).hosts)
            files[AUTHORITY] += _trusted(secret, now)
            data = {key: base64.b64encode(content).decode() for key, content in files.items()}
            try:
                await self.client.replace(_SECRETS, secret | {"data": data})
            except ApiError as error:
                if error.code == 409:  # another manager was faster
                    return await self.look()
                raise
            log.info("created a certificate for the webhook, valid for %d days", VALID.days)
        await self._trust(base64.b64encode(files[AUTHORITY]).decode())
        write_whole(self.folder, {each: files[each] for each in (AUTHORITY, CERTIFICATE, KEY)})

    async def _trust(self, bundle: str) -> None:
        """Write the authority into those of the configurations that there are."""
        for resource in _CONFIGURATIONS:
            found: Object | None = await self.client.get(resource, "", self.webhooks)
            if found is None:
                continue
            webhooks: list[Any] = found.get("webhooks") or []
            if any(each["clientConfig"].get("caBundle") != bundle for each in webhooks):
                changed = [{"name": each["name"], "clientConfig": {"caBundle": bundle}} for each in webhooks]
                await self.client.merge_members(resource, self.webhooks, {"webhooks": changed})
                log.info("wrote the CA of the webhook's certificate into the %s", resource.kind)


def _due(files: dict[str, bytes], now: datetime.datetime) -> bool:
    """Whether there is no certificate, or too little of its life is left."""
    if not all(files.get(each) for each in (AUTHORITY, CERTIFICATE, KEY)):
        return True
    try:
        certificate = x509.load_pem_x509_certificate(files[CERTIFICATE])
    except ValueError:
        return True
    life = certificate.not_valid_after_utc - certificate.not_valid_before_utc
    return certificate.not_valid_after_utc - now < life * _RENEWED_AT


def _trusted(secret: Object, now: datetime.datetime) -> bytes:
    """The authority of the certificate that is in use, if there is one that still holds."""
    bundle = base64.b64decode((secret.get("data") or {}).get(AUTHORITY, ""))
    try:
        newest = x509.load_pem_x509_certificates(bundle)[0]
    except (ValueError, IndexError):
        return b""
    return newest.public_bytes(Encoding.PEM) if newest.not_valid_after_utc > now else b""


@asynccontextmanager
async def issuing(client: Client, serving: Serving | None) -> AsyncIterator[None]:
    """Keep the webhook's certificate valid while the block runs, where the manager makes it; see `Issuing.first`."""
    if serving is None or not serving.service:
        yield
        return
    made = Issuing(client, serving.service, serving.secret, serving.webhooks, serving.certificates)
    await made.first()
    following = asyncio.create_task(made.follow(), name="issuing")
    try:
        yield
    finally:
        following.cancel()
        await asyncio.gather(following, return_exceptions=True)
