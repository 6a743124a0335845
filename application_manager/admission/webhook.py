"""The webhook: AdmissionReviews over HTTPS, in the manager's event loop.

If a review fails here, the API server receives an error. With failurePolicy Ignore it then stores the object, and the
object's condition later reports the findings. So no request waits in a queue: requests beyond the maximum get 503,
without Retry-After, which would make the API server hold the request and send it again.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from aiohttp import web

from application_manager.core.findings.reviews import OverloadedError, ReviewError
from application_manager.core.findings.webhooks import certificate_secret
from application_manager.measures import Measures
from wayside.kubernetes.connection import ConfigurationError
from wayside.process.servingcertificate import ServingCertificate

AT_ONCE = 32
"""The maximum number of concurrent reviews of one kind; further ones get 503 immediately."""


LARGEST = 8 * 1024 * 1024  # bytes of a request: etcd accepts 1.5 MiB per object, and an update contains two

PORT_OPTION = "--admission-port"
FOLDER_OPTION = "--admission-certificates"

Review = Callable[[Any], Awaitable[dict[str, Any]]]

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class WebhookOptions:
    """The port of the webhook, and the folder with its certificate and key.

    `service` and `webhooks`: if this manager issues the certificate itself, the Service to issue it for, as
    NAMESPACE/NAME, and the name of the webhook configurations.
    """

    port: int
    certificates: Path
    service: str = ""
    webhooks: str = ""

    @property
    def secret(self) -> tuple[str, str]:
        """Namespace and name of the Secret with the certificate that this manager issues."""
        return certificate_secret(self.service)


class ReviewHandler:
    """Responds to the AdmissionReviews of one webhook."""

    def __init__(self, review: Review, ready: Callable[[], bool], measures: Measures) -> None:
        """`ready`: whether the caches are synced."""
        self._review = review
        self._ready = ready
        self._measures = measures
        self._in_progress = 0

    async def answer(self, request: web.Request) -> web.Response:
        """The response to one AdmissionReview; an HTTP error if the review failed."""
        if not self._ready():
            return self._none(503, "the caches are not synced yet")
        if self._in_progress >= AT_ONCE:
            return self._none(503, f"{AT_ONCE} reviews are in progress: try again")
        self._in_progress += 1
        try:
            question = msgspec.json.decode(await request.read())
            return web.json_response(body=msgspec.json.encode(await self._review(question)))
        except OverloadedError as error:
            return self._none(503, str(error))
        except (ReviewError, msgspec.DecodeError, UnicodeDecodeError) as error:
            return self._none(400, str(error))
        except web.HTTPException:
            self._measures.reviewed("", "failed")
            raise
        except Exception as error:  # a defect of ours must not prevent any change
            log.exception("cannot review an object")
            return self._none(500, f"{type(error).__name__}: {error}")
        finally:
            self._in_progress -= 1

    def _none(self, status: int, why: str) -> web.Response:
        self._measures.reviewed("", "failed")
        return web.Response(status=status, text=f"{why}\n")


@asynccontextmanager
async def webhook(options: WebhookOptions | None, handlers: Mapping[str, ReviewHandler]) -> AsyncIterator[None]:
    """Serve the handlers, by their paths, on all addresses while the block runs; nothing if `options` is None.

    Raises ConfigurationError if the port is in use, CertificateError if there is no valid certificate.
    """
    if options is None:
        yield
        return
    certificate = ServingCertificate(options.certificates, FOLDER_OPTION)
    application = web.Application(client_max_size=LARGEST)
    for path, handler in handlers.items():
        application.router.add_post(path, handler.answer)
    # A request that the API server has cancelled is cancelled here too.
    runner = web.AppRunner(
        application, access_log=None, handle_signals=False, shutdown_timeout=1, handler_cancellation=True
    )
    await runner.setup()
    following = asyncio.create_task(certificate.follow(), name="certificate")
    try:
        try:
            await web.TCPSite(runner, port=options.port, ssl_context=certificate.context).start()
        except OSError as error:
            reason = error.strerror or error
            raise ConfigurationError(f"{PORT_OPTION} {options.port}: {reason}: give another port") from error
        log.info("answering AdmissionReviews on port %s", options.port)
        yield
    finally:
        following.cancel()
        await asyncio.gather(following, return_exceptions=True)
        await runner.cleanup()
